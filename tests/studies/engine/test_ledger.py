"""The folder of a study: whole files, locks that end with their process, nothing misread."""

import json

import pytest

from sme_registry.errors import OptionError, SpecError
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.result import CellFailure
from tests.studies.cells import small_file

FILE = small_file()
CELL, OTHER = (planned.cell for planned in FILE.plan.cells)


@pytest.fixture(scope="module")
def result():
    return run_cell(CELL)


def failed(cell):
    return CellFailure(key=cell.digest, cell=cell, error="E", traceback="", versions={})


def result_path(folder, cell):
    return folder / "cells" / f"{cell.digest.removeprefix('sha256:')}.json"


def test_a_result_is_read_back_as_it_was_and_ends_the_failure_before_it(tmp_path, result):
    ledger = Ledger(tmp_path / "study")
    assert ledger.results() == {}
    ledger.write(failed(CELL))
    assert ledger.failures([CELL.digest]) == {CELL.digest: failed(CELL)}
    ledger.write(result, b"a model")
    assert ledger.result(CELL.digest) == result
    assert ledger.results() == ledger.results([OTHER.digest, CELL.digest]) == {CELL.digest: result}
    assert ledger.failures() == {}
    assert ledger.model_path(CELL.digest).read_bytes() == b"a model"


@pytest.mark.parametrize("damage", ["half", "other", "not JSON", "edited"])
def test_a_file_that_is_no_result_of_its_cell_counts_as_absent_and_is_set_aside(
    damage, tmp_path, result
):
    said = []
    ledger = Ledger(tmp_path, said.append)
    ledger.write(result)
    path = result_path(tmp_path, CELL)
    text = path.read_text()
    if damage == "half":
        path.write_text(text[: len(text) // 2])
    elif damage == "other":
        path = path.rename(result_path(tmp_path, OTHER))
    elif damage == "not JSON":
        path.write_bytes(b"\x00" * 100)
    else:
        path.write_text(json.dumps(json.loads(text) | {"online_regret": "none"}))
    damaged = path.read_bytes()
    cell = OTHER if damage == "other" else CELL
    assert ledger.result(cell.digest) is None
    assert ledger.results() == {}
    assert path.read_bytes() == damaged  # reading changes nothing
    ledger.set_aside(cell.digest)
    assert not path.exists()
    assert path.with_name(f"{path.name}.corrupt").read_bytes() == damaged
    (line,) = said
    assert str(path) in line
    assert "runs again" in line


def test_a_good_result_is_not_set_aside_and_a_killed_write_leaves_nothing_to_read(tmp_path, result):
    ledger, path = Ledger(tmp_path), result_path(tmp_path, CELL)
    ledger.write_plan(FILE)
    path.parent.mkdir()
    (path.parent / f".{path.name}.x1y2z3").write_text("{")
    assert ledger.results() == {}
    assert ledger.plan_file() == FILE
    ledger.write(result)
    ledger.set_aside(CELL.digest)
    assert ledger.result(CELL.digest) == result


def test_a_folder_of_other_files_is_no_study(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OptionError, match=r"thesis\.tex"):
        Ledger(tmp_path).plan_file()
    with pytest.raises(OptionError, match="Not a directory"):
        Ledger(tmp_path / "thesis.tex").plan_file()
    assert Ledger(tmp_path / "new").plan_file() is None


def test_a_plan_that_was_damaged_is_an_error_and_not_a_new_study(tmp_path):
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(SpecError, match="not JSON"):
        Ledger(tmp_path).plan_file()
