"""Two algorithms of a study, compared in pairs of runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sme_registry import studies
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.statistics import iqm
from sme_registry.studies.report.classes import ALL
from sme_registry.studies.report.compare import comparison_tables
from tests.commands import good


@pytest.fixture(scope="module")
def frames(finished: Path) -> studies.StudyFrames:
    return studies.load(finished)


def row(table: pd.DataFrame, class_name: str, metric: str = "wd_regret") -> pd.Series:
    return table[(table.class_name == class_name) & (table.metric == metric)].iloc[0]


def test_the_difference_is_that_of_runs_with_one_instance_and_seed(frames) -> None:
    table = studies.compare(frames, "Alpha", "Beta")
    runs = frames.results.drop_duplicates(["class_name", "algorithm", "run"])
    regrets = runs[runs.class_name == "k-25"].pivot_table("wd_regret", "run", "algorithm")
    both = regrets[["Alpha", "Beta"]].dropna()
    found = row(table, "k-25")
    assert (found.pairs, found.enough_pairs, found.verdict) == (3, False, "indication")
    assert found.difference == pytest.approx(float(iqm(both.Alpha - both.Beta)))
    assert found.first_level == pytest.approx(float(iqm(both.Alpha)))
    assert found.low < found.difference < found.high < 0


def test_all_classes_is_the_mean_of_the_classes(frames) -> None:
    table = studies.compare(frames, "Alpha", "Beta", ["ood_regret"])
    classes = table[table.class_name != ALL]
    total = row(table, ALL, "ood_regret")
    assert total.difference == pytest.approx(classes.difference.mean())
    assert total.pairs == classes.pairs.sum() == 23


def test_the_difference_the_other_way_round_is_its_mirror_image(frames) -> None:
    one, other = (studies.compare(frames, *pair) for pair in (("Alpha", "Beta"), ("Beta", "Alpha")))
    assert np.allclose(one.difference, -other.difference)
    assert np.allclose(one.low, -other.high)
    mirrored = {"better": "worse", "worse": "better", "open": "open", "indication": "indication"}
    assert list(other.verdict) == [mirrored[verdict] for verdict in one.verdict]


def test_a_single_pair_has_no_interval(frames) -> None:
    first = studies.StudyFrames(frames.results[frames.results.run == 0], frames.curves)
    table = studies.compare(first, "Alpha", "Beta")
    assert table.low.isna().all()
    assert set(table.verdict) == {"open"}


def test_bad_names_are_refused(frames, finished: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'Alpha'"):
        studies.compare(frames, "Alfa", "Beta")
    with pytest.raises(UnknownNameError, match="Did you mean 'wd_regret'"):
        studies.compare(frames, "Alpha", "Beta", ["wd_regrt"])
    with pytest.raises(OptionError, match="given twice"):
        studies.compare(finished, "Alpha", "Alpha")


def test_the_command_writes_tables_and_figures(finished: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    command = ["study", "compare", str(finished), "Alpha", "Beta", "--out", str(tmp_path), "--json"]
    assert json.loads(good(*command).stdout) == json.loads(
        (tmp_path / "differences.json").read_text()
    )
    assert {path.name for path in tmp_path.iterdir()} == {
        "differences.csv", "differences.json", "differences-wd-regret.tex",
        "differences-ood-regret.tex", "differences.png", "differences.pdf",
        "learning-curves-by-class.png", "learning-curves-by-class.pdf",
    }  # fmt: skip
    text = good(*command[:-3]).stdout
    assert "Alpha − Beta" in text
    assert "(n = 3)" in text
    few = "With fewer than 5 pairs on a class, an interval covers"
    assert few in " ".join(text.split())
    source = (tmp_path / "differences-wd-regret.tex").read_text()
    assert "\\label{tab:differences-wd-regret-Alpha-Beta}" in source
    assert few in " ".join(source.split())


def test_pairs_that_share_an_instance_are_no_independent_draws_of_the_task(frames) -> None:
    table = studies.compare(frames, "Alpha", "Beta")
    assert (table.instances == table.pairs).all()
    assert "share an instance" not in comparison_tables(table)[0].note
    shared = frames.results.assign(spec_digest=frames.results.class_name)
    table = studies.compare(studies.StudyFrames(shared, frames.curves), "Alpha", "Beta")
    assert set(table[table.class_name != ALL].instances) == {1}
    assert "share an instance" in comparison_tables(table)[0].note
