"""The streams of a study in its report: frames, tables, findings, figures and the page."""

import dataclasses
import functools
import shutil

import numpy as np
import pytest
from scipy.stats import trim_mean

from sme_registry import studies
from sme_registry.errors import OptionError
from sme_registry.io import read_json
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report import analysis as tables
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.texts import text_tables
from sme_registry.studies.result import CellFailure
from tests.studies import finished
from tests.studies.finished import found, rows_of
from tests.studies.lives import AGENTS, STREAMS, TASK, live, stream_study

pytest.importorskip("matplotlib")

from sme_registry.studies.report.write import page, write_report
from tests.geometry import assert_readable
from tests.page import Page

FIGURES = {
    "stream-metrics", "stream-regret", "stream-plasticity", "stream-learning-curves",
    *(f"stream-{kind}-{name}" for kind in ("retention", "performance") for name in STREAMS),
}  # fmt: skip
RUN = ["class_name", "algorithm", "run"]


@pytest.fixture(scope="module")
def gaps(lived, tmp_path_factory):
    """Without the fresh agents of Tired, and two lives of Stubborn, of which one failed."""
    folder = shutil.copytree(lived, tmp_path_factory.mktemp("gaps") / "study")
    for planned in stream_study().plan.cells:
        stubborn = (planned.class_name, planned.algorithm) == ("Switch", "Stubborn")
        fresh_of_tired = (planned.algorithm, planned.phase) == ("Tired", 0)
        if fresh_of_tired or (stubborn and planned.phase is None and planned.run > 2):
            (folder / "cells" / f"{planned.cell.digest[7:]}.json").unlink(missing_ok=True)
            if stubborn and planned.run == 3:
                failed, error = planned.cell, "ValueError: <b>bad</b>"
    failure = CellFailure(key=failed.digest, cell=failed, error=error, traceback="", versions={})
    Ledger(folder).write(failure)
    return folder


def test_fresh_agents_alone_make_a_report(lived, tmp_path):
    ledger = Ledger(tmp_path / "study")
    file = Ledger(lived).study_file()
    ledger.write_plan(file)
    fresh = next(planned for planned in file.plan.cells if planned.phase is not None)
    ledger.write(Ledger(lived).results([fresh.cell.digest])[fresh.cell.digest])
    names = {path.name for path in write_report(ledger.folder)}
    assert {"index.html", "table.csv"} <= names


analysed = functools.cache(finished.analysed)


@pytest.fixture(scope="module")
def streams(lived):
    """The tables of `study`."""
    return analysed(lived)


def text_of(analysis):
    """The text of the page, without figures and tables."""
    return Page(page(analysis)).words


within = functools.partial(rows_of, region="WD")


# Frames


def test_frames_have_the_numbers_of_the_reports_and_of_the_fresh_agents(lived):
    loaded, results = studies.load_streams(lived), Ledger(lived).results()
    assert len(loaded.lives) == 3 * 3 * 5 * 4  # streams, algorithms, runs; WD, two shells, OOD
    assert not loaded.lives.duplicated([*RUN, "region"]).any()
    for row in loaded.lives.itertuples():
        result = results[row.key]
        fresh = [results[cell.digest] for cell in result.cell.fresh]
        report = result.stream_report
        report = report.with_fresh(
            [each.any_report for each in fresh], [each.online_regret for each in fresh]
        )
        agent, regret = report.region(row.region).agent, report.dynamic_regret
        for name in ("average_performance", "forgetting", "plasticity_ratio"):
            assert getattr(row, name) == agent.final(name)
        own = [agent.normalised_regret[v.visit][v.phase] for v in report.visits]
        assert row.visited_regret == pytest.approx(np.mean(own), rel=1e-12)
        assert row.learning_transfer == regret.learning_transfer
        assert row.online_regret == pytest.approx(row.dynamic_regret / row.steps)
        assert (row.fresh_agents, row.stream_digest) == (len(fresh), result.cell.stream.digest)
    keys = loaded.lives.drop_duplicates("key").set_index(RUN).key
    for place, rows in loaded.visits.groupby(RUN):
        report = results[keys[place]].stream_report
        for row in rows.itertuples():
            agent = report.region(row.region).agent
            assert row.normalised_regret == agent.normalised_regret[row.visit][row.phase]
            assert row.online_regret == report.dynamic_regret.visits[row.visit].online_regret
            assert row.lifetime == report.visits[row.visit].lifetime
            ratio = row.normalised_regret / row.fresh_normalised_regret
            assert row.plasticity_ratio == pytest.approx(ratio)
    cycle = within(loaded.retention, class_name="Cycle", algorithm="Tired", run=3)
    agent = results[keys["Cycle", "Tired", 3]].stream_report.region().agent
    values = [*agent.initial_normalised_regret, *np.ravel(agent.normalised_regret)]
    assert cycle.normalised_regret.tolist() == values
    assert cycle.visit.isna().tolist() == [True] * 2 + [False] * 8
    assert tuple(cycle.visit[2:]) == (0, 0, 1, 1, 2, 2, 3, 3)


def test_captions_count_lives_and_no_references(lived):
    tables = text_tables(analysed(lived, lambda planned: planned.run > 1))
    captions = [table.caption for table in tables if table.name.startswith("stream-metrics")]
    assert captions
    assert all(caption.startswith("IQM over 2 lives, ") for caption in captions)


def test_results_and_curves_hold_single_tasks_alone(lived, tmp_path):
    learner = {"name": "Alpha", "uses": "tests.studies.learners:blend",
               "hyperparameters": {"half_life": 10.0}}  # fmt: skip
    fields = {
        "classes": [{"name": "small", "setting": {"horizon": 10}, "seeds": [1]}],
        "streams": [{"name": "Related", "stream": STREAMS["Related"]}],
        "algorithms": [learner],
        "steps": 20,
        "evaluations": 2,
        "evaluation_episodes": 1,
    }
    file = stream_study(seeds=1, **fields)
    ledger = live(file, tmp_path, lambda planned: not planned.in_stream)
    for planned in file.plan.cells:
        if not planned.in_stream:
            ledger.write(run_cell(planned.cell))
    results, curves = studies.load(tmp_path)
    assert set(results.class_name) == set(curves.class_name) == {"small"}
    assert set(studies.load_streams(tmp_path).lives.class_name) == {"Related"}
    text = text_of(analysed(tmp_path))
    assert "1 class and 1 stream × 1 algorithm × 1 seed: 5 of 5 runs have finished" in text
    assert "No class was shown" not in text  # there is no other class
    assert "Alpha was not shown to forget" in text
    with pytest.raises(OptionError, match=r"has streams alone.*sme study report"):
        studies.compare(lived, "Tired", "Stubborn")


# Tables


def test_a_table_has_the_iqm_over_lives_with_its_interval(streams):
    lives = streams.tables["stream_lives"]
    for row in streams.tables["stream_metrics"].itertuples():
        place = {"class_name": row.class_name, "algorithm": row.algorithm, "region": row.region}
        values = within(lives, **place)[row.metric].to_numpy()
        assert row.runs == 5
        assert row.iqm == pytest.approx(trim_mean(values, 0.25), abs=1e-12)
        assert row.low <= row.iqm <= row.high
    at = {"class_name": "Related", "algorithm": "Forgetful", "phase": 1}
    M, retention = (within(streams.tables[f"stream_{n}"], **at) for n in ("matrices", "retention"))
    assert np.isnan(M.visit.astype(float)[:1]).all()
    for row in M[1:].itertuples():
        values = rows_of(retention, visit=row.visit)
        assert row.iqm == pytest.approx(trim_mean(values.normalised_regret, 0.25))


def test_streams_are_compared_by_runs_of_equal_number(streams):
    rows = rows_of(streams.tables["stream_contrasts"], algorithm="Forgetful")
    axes = {"Related": "tasks", "Cycle": "schedule"}
    assert dict(zip(rows.class_name, rows.axis, strict=True)) == axes
    (row,) = rows_of(rows, class_name="Related", metric="forgetting").itertuples()
    lives = within(streams.tables["stream_lives"], algorithm="Forgetful").set_index(
        ["class_name", "run"]
    )
    change = lives.forgetting["Related"] - lives.forgetting["Switch"]
    assert row.change == pytest.approx(trim_mean(change, 0.25))
    assert (row.verdict, row.pairs) == ("better", 5)


def test_a_regret_curve_is_beside_fresh_agents_and_the_agent_frozen_after_visit_0(streams):
    lives = within(streams.tables["stream_lives"]).groupby(["class_name", "algorithm"])
    for place, curve in streams.tables["stream_regret"].groupby(["class_name", "algorithm"]):
        name, algorithm = place
        own = lives.get_group(place)
        assert curve["median"].iloc[-1] == pytest.approx(own.dynamic_regret.median())
        visits = within(streams.tables["stream_visits"], class_name=name, algorithm=algorithm)
        alone = (100 * visits.fresh_online_regret).groupby(visits.run).sum()
        assert curve.fresh.iloc[-1] == pytest.approx(alone.median())
        at_switch = curve.fresh[np.isclose(curve.lifetime, 100.0)]
        if len(at_switch):
            first = visits[visits.visit == 0].fresh_online_regret
            assert at_switch.iloc[0] == pytest.approx(100 * first.median())
        frozen = [
            life.report.reference_regret["frozen_agent"] for life in streams.lives
            if (life.planned.class_name, life.planned.algorithm) == place
        ]  # fmt: skip
        last = np.median([log.dynamic_regret for log in frozen])
        assert curve.frozen.iloc[-1] == pytest.approx(last)
        of_place = {"class_name": name, "algorithm": algorithm, "metric": "frozen_online_regret"}
        (row,) = within(streams.tables["stream_metrics"], **of_place).itertuples()
        assert row.iqm == pytest.approx(trim_mean([log.online_regret for log in frozen], 0.25))
        assert row.low <= row.iqm <= row.high
        (row,) = within(streams.tables["stream_visit_metrics"], visit=1, **of_place).itertuples()
        second = [log.visits[1].online_regret for log in frozen]
        assert row.iqm == pytest.approx(trim_mean(second, 0.25))


def test_reference_agents_are_those_that_lives_recorded_and_else_computed(streams):
    costs = tables.reference_costs(streams.lives)
    for (name, reference), logs in costs.items():
        own = [life.report for life in streams.lives if life.planned.class_name == name]
        recorded = {each.stream_digest: each.reference_regret[reference] for each in own}
        assert logs == [*recorded.values()]
    old = [
        life._replace(report=life.report.model_copy(update={"reference_regret": {}}))
        for life in streams.lives
    ]
    computed = tables.reference_costs(old)
    assert computed.keys() == costs.keys()
    for place, logs in computed.items():
        for mine, theirs in zip(logs, costs[place], strict=True):
            assert mine.online_regret == pytest.approx(theirs.online_regret, abs=0.1)
    alone = dataclasses.replace(streams, lives=old)
    assert tables.regret(alone).frozen.isna().all()


def test_what_is_missing_is_counted_and_leaves_plasticity_unknown(gaps):
    streams = analysed(gaps)
    counts = streams.tables["stream_counts"].set_index(["class_name", "algorithm"])
    assert tuple(counts.loc[("Switch", "Stubborn")]) == (3, 15, 5, 15, 1)
    assert tuple(counts.loc[("Cycle", "Tired")]) == (5, 5, 5, 10, 0)
    # The three streams have the same phase 0, and so the same fresh agents of it.
    missing = streams.tables["stream_missing"]
    assert (len(missing), missing.key.nunique()) == (2 + 3 * 5, 2 + 5)
    assert (streams.finished, streams.requested, streams.planned) == (113, 120, 120)
    tired = rows_of(streams.tables["stream_metrics"], algorithm="Tired").metric
    assert not {"plasticity_ratio", "plasticity_difference", "learning_transfer"} & set(tired)
    assert {"forgetting", "online_regret"} < set(tired)
    assert rows_of(streams.tables["stream_regret"], algorithm="Tired").fresh.isna().all()
    tired = found(streams, section="streams", class_name="Switch", algorithm="Tired")
    assert "plasticity ratio" not in tired
    assert found(streams)["fresh agents"].value == 15
    text = text_of(analysed(gaps))
    for words in (
        "113 of 120 runs have finished",
        "Tired on phase 0 of Switch alone, run 0",
        "Stubborn on Switch, run 3: failed: ValueError: <b>bad</b>",
    ):
        assert words in text


# Findings


def verdicts(rows, **at):
    """The verdicts of findings with these values, by algorithm."""
    rows = rows_of(rows, **at)
    return dict(zip(rows.algorithm, rows.verdict, strict=True))


def test_findings_name_what_each_agent_was_made_to_do(streams):
    rows = findings(streams)
    place = {"section": "streams", "class_name": "Related"}
    forgets = {"Tired": "above", "Forgetful": "above", "Stubborn": "open"}
    judged = verdicts(rows, question="forgetting", **place)
    assert list(judged.items()) == list(forgets.items())  # who forgets most comes first
    more = rows_of(rows, question="forgets more", class_name="Related")
    assert list(more.verdict) == ["below", "above", "above"]
    assert ((more.low <= more.value) & (more.value <= more.high)).all()
    assert more.sentence.iloc[0].startswith("Forgetful forgets less than Tired: the difference is")
    more = rows_of(rows, question="forgets more", class_name="Switch")
    assert list(more.verdict) == ["open", "above", "above"]
    plasticity = {"Forgetful": "open", "Tired": "above", "Stubborn": "above"}
    at = {"section": "streams", "class_name": "Switch"}
    assert verdicts(rows, question="plasticity ratio", **at) == plasticity
    changes = rows[rows.section == "stream_changes"]
    assert set(changes.class_name) == {"Related"}  # not Cycle
    assert "relatedness makes" in changes[changes.question == "relatedness"].sentence.iloc[0]
    for metric, verdict in (("forgetting", "better"), ("plasticity ratio", "open")):
        assert verdicts(changes, question=metric)["Forgetful"] == verdict


def changed(analysis, metric, ends, runs=5):
    """Tables with another IQM and interval of a metric, for all algorithms or by algorithm."""
    rows = analysis.tables["stream_metrics"].copy()
    for name, each in (ends if isinstance(ends, dict) else dict.fromkeys(AGENTS, ends)).items():
        at = (rows.metric == metric) & (rows.algorithm == name)
        rows.loc[at, ["runs", "iqm", "low", "high"]] = runs, *each
    return finished.with_tables(analysis, stream_metrics=rows)


@pytest.mark.parametrize(
    ("metric", "interval", "verdict", "words"),
    [
        ("plasticity_ratio", (0.9, 0.8, 1.2), "open", "neither worse nor better"),
        ("plasticity_ratio", (1.3, 1.1, 1.5), "above", "ends its visits worse"),
        ("plasticity_ratio", (0.7, 0.5, 0.9), "below", "ends its visits better"),
        ("forgetting", (0.2, -0.1, 0.5), "open", "was not shown to forget"),
        ("forgetting", (-0.2, -0.3, -0.1), "below", "better on earlier phases"),
        ("forgetting", (0.4, 0.2, 0.6), "above", "forgets: forgetting 0.40 (95 % interval 0.20 to"),
        ("learning_transfer", (0.4, 0.2, 0.6), "above", "has less regret during its visits"),
        ("forward_transfer", (-0.2, -0.3, -0.1), "below", "worse on phases before their first"),
    ],
)
def test_a_metric_is_judged_by_its_interval_against_the_neutral_value(
    streams, metric, interval, verdict, words
):
    question = metric.replace("_", " ")
    row = found(changed(streams, metric, interval), class_name="Switch")[question]
    assert row.verdict == verdict
    assert words in row.sentence
    few = found(changed(streams, metric, interval, runs=4), class_name="Switch")[question]
    assert few.verdict == (verdict if verdict == "open" else f"{verdict}_few")


def test_agents_that_have_learnt_nothing_are_marked(streams):
    assert "unlearnt" not in set(findings(streams).verdict)
    rows = findings(changed(streams, "visited_regret", {"Tired": (0.97, 0.95, 0.99)}))
    assert set(rows[rows.verdict == "unlearnt"].algorithm) == {"Tired"}


# The report


def test_the_report_of_streams_alone_is_whole_readable_and_the_same_each_time(
    lived, streams, tmp_path, drawn
):
    files = write_report(lived, tmp_path / "one", ["html", "csv", "latex"], full=True)
    page = Page(files[0].read_text())
    ids = page.values("id")
    names = [name.removeprefix("figure-") for name in ids if name.startswith("figure-")]
    assert set(names) == FIGURES
    assert "findings" not in ids
    for words in ("120 of 120 runs have finished", "Tired forgets more than Stubborn"):
        assert words in page.words
    rows = read_json(tmp_path / "one" / "findings.json")["findings"]
    forgetting = [row["class_name"] for row in rows if row["question"] == "forgetting"]
    assert list(dict.fromkeys(forgetting)) == [*STREAMS]
    written = {path.stem for path in files if path.suffix == ".csv"}
    assert "stream_lives" in written
    assert "results" not in written
    again = write_report(lived, tmp_path / "two", ["csv", "latex"], full=True)
    for path in again:
        first = tmp_path / "one" / path.relative_to(tmp_path / "two")
        assert path.read_bytes() == first.read_bytes()
        assert path.suffix == ".csv" or path.read_text().isascii()
    assert_shown(streams, dict(zip(names, drawn, strict=True)))


def assert_shown(streams, figures):
    """Every figure is readable and shows every agent."""
    for figure in figures.values():
        assert_readable(figure)
    for name in ("stream-metrics", "stream-regret", "stream-plasticity"):
        labels = [text.get_text() for text in figures[name].legends[0].get_texts()]
        assert labels[:3] == [*AGENTS]
        assert ("frozen after visit 0" in labels) == (name == "stream-regret")
    for name in ("stream-retention-Cycle", "stream-performance-Cycle"):
        titles = [axes.get_title() for axes in figures[name].axes if axes.get_title()]
        assert titles == [*AGENTS]
    first = figures["stream-retention-Switch"].axes[0].images[0].get_array()
    rows = within(streams.tables["stream_matrices"], class_name="Switch", algorithm="Forgetful")
    np.testing.assert_allclose(np.ravel(first), rows.iqm)


def test_a_life_of_one_visit_is_compared_with_no_fresh_agent(tmp_path):
    drift = {"rotation": 1.0, "increments": 2}
    alone = {"phases": [{"spec": TASK, "steps": 100, "drift": drift}]}
    plain = {"phases": [{"spec": TASK, "steps": 100}]}
    named = [{"name": "drift", "stream": alone}, {"name": "plain", "stream": plain}]
    live(stream_study(streams=named, seeds=2), tmp_path)
    lives = studies.load_streams(tmp_path).lives
    assert set(lives[lives.class_name == "drift"].fresh_agents) == {0}
    assert lives.plasticity_ratio.isna().all()
    assert not {"fresh agents", "forgetting", "plasticity ratio"} & set(found(analysed(tmp_path)))
    assert "a life is a fresh agent itself" in text_of(analysed(tmp_path))


def test_lives_of_a_single_seed_have_no_intervals(tmp_path):
    live(stream_study(seeds=1), tmp_path)
    rows = findings(finished.analysed(tmp_path))
    assert set(rows[rows.section == "streams"].verdict) == {"open"}
    text = text_of(finished.analysed(tmp_path))
    assert "(no interval, 1 life)" in text
    assert "nan" not in text
    fresh = finished.analysed(tmp_path, lambda planned: planned.phase is None)
    assert "No life has finished yet" in text_of(fresh)
