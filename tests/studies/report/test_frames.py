"""`sme_registry.studies.load`: the finished runs of a study as tidy data frames."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sme_registry import studies
from sme_registry.errors import OptionError
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.report import frames


@pytest.fixture(scope="module")
def loaded(finished: Path) -> studies.StudyFrames:
    return studies.load(finished)


def test_results_have_one_row_per_run_and_region_in_the_plans_order(
    loaded: studies.StudyFrames,
) -> None:
    places = loaded.results[["class_name", "algorithm", "run", "region"]]
    assert len(places) == 73 * 3
    assert not places.duplicated().any()
    assert list(places.class_name.unique()) == [
        "default", "k-25", "r_min-0_5", "complexity-10", "plane",
    ]  # fmt: skip
    first = places[(places.class_name == "default") & (places.algorithm == "Alpha")]
    assert list(first.run) == [run for run in range(5) for _ in range(3)]
    assert list(first.region) == ["WD", "OOD 1", "OOD 2"] * 5


def test_every_row_has_the_numbers_of_its_report(
    finished: Path, loaded: studies.StudyFrames
) -> None:
    results = Ledger(finished).results()
    for row in loaded.results.itertuples():
        report = results[row.key].report
        (region,) = (region for region in report.regions if region.name == row.region)
        for field in set(type(region).model_fields) - {"name", "channels"}:
            assert getattr(row, field) == getattr(region, field)
        index = report.regions.index(region)
        linear = report.references["linear_least_squares"][index]
        assert row.linear_normalised_regret == linear.normalised_regret
        assert row.constant_similarity == report.references["constant_half"][index].similarity
        assert (row.wd_regret, row.ood_regret) == (report.wd_regret, report.ood_regret)
        assert row.ood_decay == row.ood_regret - row.wd_regret
        spec = results[row.key].cell.spec
        assert (row.spec_digest, row.complexity, row.k) == (spec.digest, spec.complexity, spec.k)


def test_curves_have_one_row_per_evaluation(finished: Path, loaded: studies.StudyFrames) -> None:
    results = Ledger(finished).results()
    runs = frames.runs(loaded.results).set_index(frames.RUN).key
    assert len(loaded.curves) == 73 * 20
    for place, rows in loaded.curves.groupby(frames.RUN):
        curve = results[runs[place]].curve
        assert tuple(rows.step) == curve.steps
        for field in ("episode_return", "regret", "similarity", "length"):
            assert tuple(rows[field]) == getattr(curve, field)


def test_final_return_is_in_percent_of_the_optimum(loaded: studies.StudyFrames) -> None:
    last = loaded.curves.groupby(frames.RUN).episode_return.apply(lambda x: x.iloc[-2:].mean())
    expected = frames.runs(loaded.results).set_index(frames.RUN).final_return
    assert np.allclose(last / 20 * 100, expected.reindex(last.index))


def test_every_column_is_documented_and_is_there_without_results(
    finished: Path, loaded: studies.StudyFrames, tmp_path: Path
) -> None:
    documented = set(re.findall(r"\w+", str(frames.__doc__)))
    (tmp_path / "plan.json").write_bytes((finished / "plan.json").read_bytes())
    for empty, full in zip(studies.load(tmp_path), loaded, strict=True):
        assert not set(full) - documented
        assert len(empty) == 0
        pd.testing.assert_series_equal(empty.dtypes, full.dtypes)


def test_a_folder_without_a_study_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="holds no study"):
        studies.load(tmp_path)


def test_the_public_names_load_on_first_use() -> None:
    for name in studies.__all__:
        assert getattr(studies, name).__name__ == name
    assert set(studies.__all__) <= set(dir(studies))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = studies.nothing


def test_only_results_need_pandas() -> None:
    script = (
        "import sys; sys.modules['pandas'] = None\n"
        "from sme_registry import studies\n"
        "from sme_registry.errors import MissingDependencyError\n"
        "studies.run_study, studies.study_status, studies.CellResult\n"
        "try:\n"
        "    studies.load\n"
        "except MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120
    )
    assert "[studies]" in done.stdout
