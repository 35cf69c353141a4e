"""The streams of a study in its report: frames, tables, findings, figures and the page."""

from __future__ import annotations

import dataclasses
import functools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import trim_mean

from sme_registry import studies
from sme_registry.errors import OptionError
from sme_registry.io import read_json
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.result import CellFailure
from sme_registry.studies.report.analysis import Analysis, analyse
from sme_registry.studies.report.findings import Findings, findings
from sme_registry.studies.report.frames import plan_file
from sme_registry.studies.report.streams import frames, tables
from sme_registry.studies.report.streams.analysis import StreamAnalysis
from sme_registry.studies.report.streams.findings import StreamFinding, StreamFindings
from tests.studies.lives import AGENTS, STREAMS, TASK, live, stream_study

pytest.importorskip("matplotlib")

from sme_registry.plots.style import COLOURS
from sme_registry.studies.report.figures import draw_figures
from sme_registry.studies.report.page import page
from sme_registry.studies.report.write import write_report
from tests.geometry import assert_readable
from tests.studies.report.test_report import Page

FIGURES = {
    "stream-metrics", "stream-regret", "stream-plasticity", "stream-learning-curves",
    *(f"stream-{kind}-{name}" for kind in ("retention", "performance") for name in STREAMS),
}  # fmt: skip
METRICS = ("average_performance", "forgetting", "plasticity_ratio", "learning_transfer")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every life and fresh agent has finished."""
    return live(stream_study(), tmp_path_factory.mktemp("lives")).folder


@pytest.fixture(scope="module")
def gaps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without the fresh agents of Tired, and two lives of Stubborn, of which one failed."""
    file = stream_study()

    def gone(planned: Any) -> bool:
        if planned.phase is not None:
            return bool(planned.algorithm == "Tired" and planned.phase == 0)
        return (planned.class_name, planned.algorithm) == ("Switch", "Stubborn") and planned.run > 2

    ledger = live(file, tmp_path_factory.mktemp("gaps"), gone)
    cell = next(p.cell for p in file.plan.cells if gone(p) and p.algorithm == "Stubborn")
    error = {"error": "ValueError: <b>bad</b>", "traceback": "", "versions": {}}
    ledger.write(CellFailure(key=cell.digest, cell=cell, **error))
    return ledger.folder


@functools.cache
def analysed(folder: Path) -> Analysis:
    ledger = Ledger(folder)
    failures = {key: failure.error for key, failure in ledger.failures().items()}
    return analyse(plan_file(ledger), ledger.results(), failures, draws=300)


def streams_of(folder: Path) -> StreamAnalysis:
    streams = analysed(folder).streams
    assert streams is not None
    return streams


def found_in(folder: Path) -> StreamFindings:
    found = findings(analysed(folder)).streams
    assert found is not None
    return found


def text_of(analysis: Analysis) -> str:
    """The text of the page, without figures and tables."""
    return " ".join(Page(page(analysis, findings(analysis), [], [], [])).text.split())


def of_stream(found: StreamFindings, name: str) -> StreamFinding:
    return next(each for each in found.streams if each.class_name == name)


def within(rows: pd.DataFrame, **at: Any) -> pd.DataFrame:
    for name, value in ({"region": "WD"} | at).items():
        rows = rows[rows[name] == value]
    return rows


# Frames


def test_lives_have_the_numbers_of_their_reports_and_of_their_fresh_agents(study: Path) -> None:
    loaded, results = studies.load_streams(study), Ledger(study).results()
    assert len(loaded.lives) == 3 * 3 * 5 * 4  # streams, algorithms, runs; WD, two shells, OOD
    assert not loaded.lives.duplicated(["class_name", "algorithm", "run", "region"]).any()
    for row in loaded.lives.itertuples():
        result = results[row.key]
        fresh = [results[cell.digest] for cell in result.cell.fresh]
        report = result.stream_report
        assert report is not None
        report = report.with_fresh(
            [each.any_report for each in fresh], [each.online_regret for each in fresh]
        )
        agent, regret = report.region(row.region).agent, report.dynamic_regret
        for name in METRICS[:3]:
            assert getattr(row, name) == agent.final(name)
        own = [agent.normalised_regret[v.visit][v.phase] for v in report.visits]
        assert row.visited_regret == pytest.approx(np.mean(own), rel=1e-12)
        assert row.learning_transfer == regret.learning_transfer
        assert row.online_regret == pytest.approx(row.dynamic_regret / row.steps)
        assert (row.fresh_agents, row.stream_digest) == (len(fresh), result.cell.stream.digest)


def test_visits_and_matrices_have_one_row_for_each_number(study: Path) -> None:
    loaded, results = studies.load_streams(study), Ledger(study).results()
    keys = loaded.lives.drop_duplicates("key").set_index(["class_name", "algorithm", "run"]).key
    for place, rows in loaded.visits.groupby(["class_name", "algorithm", "run"]):
        report = results[keys[place]].stream_report
        for row in rows.itertuples():
            agent = report.region(row.region).agent
            assert row.normalised_regret == agent.normalised_regret[row.visit][row.phase]
            assert row.online_regret == report.dynamic_regret.visits[row.visit].online_regret
            assert row.lifetime == report.visits[row.visit].lifetime
            ratio = row.normalised_regret / row.fresh_normalised_regret
            assert row.plasticity_ratio == pytest.approx(ratio)
    cycle = within(loaded.retention, class_name="Cycle", algorithm="Tired", run=3)
    report = results[keys["Cycle", "Tired", 3]].stream_report
    agent = report.region().agent
    values = [*agent.initial_normalised_regret, *np.ravel(agent.normalised_regret)]
    assert cycle.normalised_regret.tolist() == values
    assert cycle.visit.isna().tolist() == [True] * 2 + [False] * 8
    assert tuple(cycle.visit[2:]) == (0, 0, 1, 1, 2, 2, 3, 3)


def test_results_and_curves_hold_single_tasks_alone(study: Path, tmp_path: Path) -> None:
    file = both_kinds()
    ledger = live(file, tmp_path, lambda planned: not planned.in_stream)
    for planned in file.plan.cells:
        if not planned.in_stream:
            ledger.write(run_cell(planned.cell))
    results, curves = studies.load(tmp_path)
    assert set(results.class_name) == set(curves.class_name) == {"small"}
    assert set(studies.load_streams(tmp_path).lives.class_name) == {"Related"}
    text = text_of(analysed(tmp_path))
    assert "1 class and 1 stream × 1 algorithm × 1 seed: 5 of 5 runs have finished" in text
    assert "Alpha has no contrasts yet" in text
    assert "The largest value is that of Alpha" in text


def both_kinds() -> StudyFile:
    algorithm = {"name": "Alpha", "uses": "tests.studies.learners:blend",
                 "hyperparameters": {"half_life": 10.0}}  # fmt: skip
    plan = StudyPlan.from_dict(
        {
            "classes": [{"name": "small", "setting": {"horizon": 10}, "seeds": [1]}],
            "streams": [{"name": "Related", "stream": STREAMS["Related"]}],
            "algorithms": [algorithm],
            "seeds": 1,
            "steps": 20,
            "evaluations": 2,
            "evaluation_episodes": 1,
            "protocol": {"states_per_region": 30, "epsilons": [0.5, 1.0]},
        }
    )
    return StudyFile(name="both", description="For tests.", digest=plan.digest, plan=plan)


def test_a_study_without_lives_has_the_same_columns(study: Path, tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_bytes((study / "plan.json").read_bytes())
    for empty, full in zip(
        studies.load_streams(tmp_path), studies.load_streams(study), strict=True
    ):
        assert len(empty) == 0
        pd.testing.assert_series_equal(empty.dtypes, full.dtypes)


def test_the_documentation_names_every_column(study: Path) -> None:
    documented = set(re.findall(r"\w+", str(frames.__doc__)))
    assert not {name for frame in studies.load_streams(study) for name in frame} - documented


def test_a_comparison_of_streams_alone_is_refused_with_the_place_of_its_numbers(
    study: Path,
) -> None:
    with pytest.raises(OptionError, match=r"has streams alone.*sme study report"):
        studies.compare(study, "Tired", "Stubborn")


# Tables


def test_a_table_has_the_iqm_over_lives_with_its_interval(study: Path) -> None:
    streams = streams_of(study)
    lives = streams.frames.lives
    for row in streams.metrics.itertuples():
        place = {"class_name": row.class_name, "algorithm": row.algorithm, "region": row.region}
        values = within(lives, **place)[row.metric].to_numpy()
        assert row.runs == 5
        assert row.iqm == pytest.approx(trim_mean(values, 0.25), abs=1e-12)
        assert row.low <= row.iqm <= row.high
    M = within(streams.matrices, class_name="Related", algorithm="Forgetful", phase=1)
    retention = within(streams.frames.retention, class_name="Related", algorithm="Forgetful")
    assert np.isnan(M.visit.astype(float)[:1]).all()
    for row in M[1:].itertuples():
        values = retention[(retention.visit == row.visit) & (retention.phase == 1)]
        assert row.iqm == pytest.approx(trim_mean(values.normalised_regret, 0.25))


def test_streams_are_compared_by_runs_of_equal_number(study: Path) -> None:
    streams = streams_of(study)
    rows = streams.contrasts[streams.contrasts.algorithm == "Forgetful"]
    assert dict(zip(rows.class_name, rows.axis, strict=True)) == {
        "Related": "tasks", "Cycle": "schedule",
    }  # fmt: skip
    (row,) = rows[(rows.class_name == "Related") & (rows.metric == "forgetting")].itertuples()
    lives = within(streams.frames.lives, algorithm="Forgetful").set_index(["class_name", "run"])
    change = lives.forgetting["Related"] - lives.forgetting["Switch"]
    assert row.change == pytest.approx(trim_mean(change, 0.25))
    assert (row.verdict, row.pairs) == ("better", 5)


def test_a_regret_curve_ends_at_the_dynamic_regret_next_to_that_of_fresh_agents(
    study: Path,
) -> None:
    streams = streams_of(study)
    lives = within(streams.frames.lives).groupby(["class_name", "algorithm"])
    for place, curve in streams.regret.groupby(["class_name", "algorithm"]):
        own = lives.get_group(place)
        assert curve["median"].iloc[-1] == pytest.approx(own.dynamic_regret.median())
        visits = within(streams.frames.visits, class_name=place[0], algorithm=place[1])
        alone = (100 * visits.fresh_online_regret).groupby(visits.run).sum()
        assert curve.fresh.iloc[-1] == pytest.approx(alone.median())
        at_switch = curve.fresh[np.isclose(curve.lifetime, 100.0)]
        if len(at_switch):
            first = visits[visits.visit == 0].fresh_online_regret
            assert at_switch.iloc[0] == pytest.approx(100 * first.median())


def test_a_life_is_beside_the_same_agent_that_stopped_learning_after_visit_0(study: Path) -> None:
    streams = streams_of(study)
    for (name, algorithm), curve in streams.regret.groupby(["class_name", "algorithm"]):
        frozen = [
            life.report.reference_regret["frozen_agent"] for life in streams.lives
            if (life.planned.class_name, life.planned.algorithm) == (name, algorithm)
        ]  # fmt: skip
        own = {"class_name": name, "algorithm": algorithm, "metric": "frozen_online_regret"}
        (row,) = within(streams.metrics, **own).itertuples()
        assert row.iqm == pytest.approx(trim_mean([log.online_regret for log in frozen], 0.25))
        assert row.low <= row.iqm <= row.high
        last = np.median([log.dynamic_regret for log in frozen])
        assert curve.frozen.iloc[-1] == pytest.approx(last)
        (row,) = within(streams.visit_metrics, visit=1, **own).itertuples()
        visits = [log.visits[1].online_regret for log in frozen]
        assert row.iqm == pytest.approx(trim_mean(visits, 0.25))


def test_reference_agents_are_those_that_lives_recorded_and_else_computed(study: Path) -> None:
    lives = streams_of(study).lives
    costs = tables.reference_costs(lives)
    for (name, reference), logs in costs.items():
        own = [life.report for life in lives if life.planned.class_name == name]
        recorded = {each.stream_digest: each.reference_regret[reference] for each in own}
        assert logs == [*recorded.values()]
    old = [
        life._replace(report=life.report.model_copy(update={"reference_regret": {}}))
        for life in lives
    ]
    computed = tables.reference_costs(old)
    assert computed.keys() == costs.keys()
    for place, logs in computed.items():
        for mine, theirs in zip(logs, costs[place], strict=True):
            assert mine.online_regret == pytest.approx(theirs.online_regret, abs=0.1)
    assert tables.regret(old).frozen.isna().all()


def test_what_is_missing_is_counted_and_leaves_plasticity_unknown(gaps: Path) -> None:
    streams = streams_of(gaps)
    counts = streams.counts.set_index(["class_name", "algorithm"])
    assert tuple(counts.loc[("Switch", "Stubborn")]) == (3, 15, 5, 15, 1)
    assert tuple(counts.loc[("Cycle", "Tired")]) == (5, 5, 5, 10, 0)
    # The three streams have the same phase 0, and so the same fresh agents of it.
    missing = streams.missing
    assert (len(missing), missing.key.nunique()) == (2 + 3 * 5, 2 + 5)
    assert (streams.finished, streams.requested, streams.planned) == (113, 120, 120)
    tired = streams.metrics[streams.metrics.algorithm == "Tired"].metric
    assert not {"plasticity_ratio", "plasticity_difference", "learning_transfer"} & set(tired)
    assert {"forgetting", "online_regret"} < set(tired)
    regret = streams.regret[streams.regret.algorithm == "Tired"]
    assert regret.fresh.isna().all()


# Findings


def test_findings_name_what_each_agent_was_made_to_do(study: Path) -> None:
    found = found_in(study)
    related = of_stream(found, "Related")
    assert (related.lives[0].algorithm, related.forgetting) == ("Tired", "forgets")
    assert [rival.verdict for rival in related.rivals] == ["more", "more"]
    for rival in related.rivals:
        assert rival.low is not None
        assert rival.high is not None
        assert 0.0 < rival.low <= rival.change <= rival.high
    switch = of_stream(found, "Switch")
    assert (switch.lives[0].algorithm, switch.forgetting) == ("Forgetful", "forgets")
    assert {rival.algorithm: rival.verdict for rival in switch.rivals} == {
        "Tired": "open", "Stubborn": "more",
    }  # fmt: skip
    verdicts = {
        life.algorithm: life.plasticity_ratio and life.plasticity_ratio.verdict
        for life in switch.lives
    }
    assert verdicts == {"Forgetful": "open", "Tired": "above", "Stubborn": "above"}
    changes = {(c.algorithm, c.metric): c for c in found.changes}
    assert {change.class_name for change in found.changes} == {"Related"}  # not Cycle
    assert all(change.related for change in found.changes)
    assert changes["Forgetful", "forgetting"].verdict == "better"
    assert changes["Forgetful", "plasticity_ratio"].verdict == "open"


def test_findings_say_what_fresh_agents_are_missing(gaps: Path) -> None:
    switch = of_stream(found_in(gaps), "Switch")
    tired = next(life for life in switch.lives if life.algorithm == "Tired")
    assert tired.plasticity_ratio is tired.learning_transfer is tired.last_plasticity_ratio is None
    assert switch.without_fresh == 5
    text = text_of(analysed(gaps))
    assert "its plasticity is unknown, since no life has all of its fresh agents" in text
    assert "5 lives have not all of their fresh agents yet" in text
    assert "113 of 120 runs have finished" in text
    assert "Tired on phase 0 of Switch alone, run 0" in text
    assert "Stubborn on Switch, run 3: failed: ValueError: <b>bad</b>" in text


@pytest.mark.parametrize(
    ("interval", "verdict", "words"),
    [
        ((0.9, 0.8, 1.2), "open", "no loss of plasticity was shown, and none excluded"),
        ((1.3, 1.1, 1.5), "above", "it loses plasticity"),
        ((0.7, 0.5, 0.9), "below", "it learns more than a fresh agent"),
    ],
)
def test_plasticity_is_judged_by_the_interval_of_the_ratio_against_1(
    study: Path, interval: tuple[float, ...], verdict: str, words: str
) -> None:
    found, text = with_metrics(study, "plasticity_ratio", interval, runs=5)
    life = of_stream(found, "Switch").lives[0]
    assert life.plasticity_ratio is not None
    assert life.plasticity_ratio.verdict == verdict
    assert f"Plasticity: {words}" in text
    _, few = with_metrics(study, "plasticity_ratio", interval, runs=3)
    assert ("there are indications that " + words in few) == (verdict != "open")


@pytest.mark.parametrize(
    ("interval", "verdict", "words"),
    [
        ((0.2, -0.1, 0.5), "open", "no algorithm was shown to forget"),
        ((-0.2, -0.3, -0.1), "none", "no algorithm forgets"),
        (
            (0.4, 0.2, 0.6),
            "forgets",
            "is 0.40 below its best (95 % interval 0.20 to 0.60, 5 lives)",
        ),
    ],
)
def test_forgetting_is_judged_by_its_interval_against_0(
    study: Path, interval: tuple[float, ...], verdict: str, words: str
) -> None:
    found, text = with_metrics(study, "forgetting", interval, runs=5)
    assert {stream.forgetting for stream in found.streams} == {verdict}
    assert words in text


Ends = tuple[float, ...]  # IQM, low, high


def test_those_are_named_whose_interval_is_above_0_also_below_the_largest_value(
    study: Path,
) -> None:
    forgetting = {"Tired": (0.5, -0.1, 1.1), "Forgetful": (0.3, 0.2, 0.4), "Stubborn": (0.1, 0, 0)}
    found, text = with_metrics(study, "forgetting", forgetting, runs=5)
    assert {stream.forgetting for stream in found.streams} == {"forgets"}
    assert "no algorithm" not in text
    assert (
        "In Switch, Forgetful forgets: at the end of the life, performance on earlier phases is "
        "0.30 below its best (95 % interval 0.20 to 0.40, 5 lives). The largest value, that of "
        "Tired, is open: 0.50 (95 % interval −0.10 to 1.10, 5 lives)."
    ) in text
    forgetting["Tired"] = (0.5, 0.3, 0.6)
    _, text = with_metrics(study, "forgetting", forgetting, runs=5)
    assert "In Switch, Tired forgets" in text
    assert "Forgetful forgets, too: 0.30 (95 % interval 0.20 to 0.40, 5 lives)." in text


def test_that_none_forgets_needs_enough_lives_of_each(study: Path) -> None:
    below = (-0.2, -0.3, -0.1)
    found, text = with_metrics(study, "forgetting", below, runs=2)
    assert {stream.forgetting for stream in found.streams} == {"open"}
    assert "no algorithm forgets" not in text
    assert "no algorithm was shown to forget: no interval lies above 0" in text
    found, _ = with_metrics(
        study, "forgetting", {"Tired": below, "Forgetful": below, "Stubborn": (-0.5, -0.9, 0.1)}, 5
    )
    assert {stream.forgetting for stream in found.streams} == {"open"}


def test_agents_that_learnt_nothing_are_not_said_to_forget_nothing(study: Path) -> None:
    changed = changed_metrics(analysed(study), "visited_regret", (0.97, 0.95, 0.99), 5)
    found, text = worded(changed_metrics(changed, "forgetting", (-0.2, -0.3, -0.1), 5))
    assert {stream.forgetting for stream in found.streams} == {"unlearnt"}
    assert "In Switch, no algorithm has learnt enough to forget anything." in text
    found, _ = worded(changed_metrics(changed, "forgetting", (0.2, 0.1, 0.3), 5))
    assert {stream.forgetting for stream in found.streams} == {"forgets"}


def with_metrics(
    study: Path, metric: str, ends: Ends | dict[str, Ends], runs: int
) -> tuple[StreamFindings, str]:
    """The findings and their words, with other intervals of a metric."""
    return worded(changed_metrics(analysed(study), metric, ends, runs))


def changed_metrics(
    analysis: Analysis, metric: str, ends: Ends | dict[str, Ends], runs: int
) -> Analysis:
    """Tables with another IQM and interval of a metric, for all algorithms or by algorithm."""
    assert analysis.streams is not None
    rows = analysis.streams.metrics.copy()
    for algorithm, each in (
        ends if isinstance(ends, dict) else dict.fromkeys(AGENTS, ends)
    ).items():
        at = (rows.metric == metric) & (rows.algorithm == algorithm)
        rows.loc[at, ["runs", "iqm", "low", "high"]] = runs, *each
    return dataclasses.replace(
        analysis, streams=dataclasses.replace(analysis.streams, metrics=rows)
    )


def worded(analysis: Analysis) -> tuple[StreamFindings, str]:
    found = findings(analysis).streams
    assert found is not None
    return found, text_of(analysis)


# The report


def test_the_report_of_streams_alone_is_whole_and_the_same_each_time(
    study: Path, tmp_path: Path
) -> None:
    formats = ["html", "csv", "latex"]
    files = write_report(study, tmp_path / "one", formats)
    page = Page(files[0].read_text())
    assert page.open == []
    assert len(set(page.ids)) == len(page.ids)
    assert all(link.removeprefix("#") in page.ids for link in page.links)
    assert {f"figure-{name}" for name in FIGURES} < set(page.ids)
    assert "findings" not in page.ids
    text = " ".join(page.text.split())
    assert "3 streams × 3 algorithms × 5 seeds: 120 of 120 runs have finished" in text
    assert "In Related, Tired forgets most: at the end of the life" in text
    assert "so the changes are those that relatedness makes" in text
    assert "online regret, frozen after visit 0" in text
    assert "A ratio below 1 is better than a fresh agent’s." in text
    assert "says nothing about plasticity" in text
    assert "no matter of plasticity" not in text
    read = Findings.from_dict(read_json(tmp_path / "one" / "findings.json"), "findings.json")
    assert read.streams is not None
    assert [stream.class_name for stream in read.streams.streams] == [*STREAMS]
    written = {path.stem for path in files if path.suffix == ".csv"}
    assert "stream_lives" in written
    assert "results" not in written
    for path in files:
        if path.suffix == ".tex":
            assert path.read_text().isascii()
    for path in write_report(study, tmp_path / "two", ["csv", "latex"]):
        assert (
            path.read_bytes()
            == (tmp_path / "one" / path.relative_to(tmp_path / "two")).read_bytes()
        )


def test_every_figure_is_readable_and_shows_every_agent(study: Path, figures: list[Any]) -> None:
    pictures, reasons = draw_figures(analysed(study), ("png",), {})
    assert ({picture.name for picture in pictures}, reasons) == (FIGURES, [])
    drawn = dict(zip([picture.name for picture in pictures], figures, strict=True))
    for figure in figures:
        assert_readable(figure)
    for name in ("stream-metrics", "stream-regret", "stream-plasticity"):
        labels = [text.get_text() for text in drawn[name].legends[0].get_texts()]
        assert labels[:3] == [*AGENTS]
        assert ("frozen after visit 0" in labels) == (name == "stream-regret")
    for name in ("stream-metrics", "stream-regret", "stream-plasticity", "stream-learning-curves"):
        lines = [line for line in drawn[name].axes[0].lines if len(line.get_xdata())]
        assert {line.get_color() for line in lines} >= set(COLOURS[: len(AGENTS)]), name
    for name in ("stream-retention-Cycle", "stream-performance-Cycle"):
        titles = [axes.get_title() for axes in drawn[name].axes if axes.get_title()]
        assert titles == [*AGENTS]
    first = drawn["stream-retention-Switch"].axes[0].images[0].get_array()
    rows = within(streams_of(study).matrices, class_name="Switch", algorithm="Forgetful")
    np.testing.assert_allclose(np.ravel(first), rows.iqm)


def test_a_life_of_one_visit_is_compared_with_no_fresh_agent(tmp_path: Path) -> None:
    drift = {"rotation": 1.0, "increments": 2}
    alone = {"phases": [{"spec": TASK, "steps": 100, "drift": drift}]}
    plain = {"phases": [{"spec": TASK, "steps": 100}]}
    streams = [{"name": "drift", "stream": alone}, {"name": "plain", "stream": plain}]
    live(stream_study(streams=streams, seeds=2), tmp_path)
    lives = studies.load_streams(tmp_path).lives
    assert set(lives[lives.class_name == "drift"].fresh_agents) == {0}
    assert lives.plasticity_ratio.isna().all()
    assert {stream.without_fresh for stream in found_in(tmp_path).streams} == {0}
    text = text_of(analysed(tmp_path))
    assert "Plasticity: a life of one visit is a fresh agent itself" in text
    assert "no life has all of its fresh agents" not in text


def test_lives_of_a_single_seed_have_no_intervals(tmp_path: Path) -> None:
    live(stream_study(seeds=1), tmp_path)
    text = text_of(analysed(tmp_path))
    assert "nothing can be said about forgetting: a single life has no interval" in text
    assert "a single life shows nothing certain" in text
    assert "(a single life, no interval)" in text
    assert "nan" not in text
    assert {each.forgetting for each in found_in(tmp_path).streams} == {"open"}


def test_fresh_agents_alone_make_a_page_that_says_so(tmp_path: Path) -> None:
    live(stream_study(seeds=1), tmp_path, lambda planned: planned.phase is None)
    text = text_of(analysed(tmp_path))
    assert "No life has finished yet" in text
