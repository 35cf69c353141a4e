"""`evaluate`: exact at both ends of the scale, reproducible, the same on every back-end."""

from __future__ import annotations

import inspect
import io
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from rich.console import Console

import sme_registry
from sme_registry import EvaluationReport, SMESpec, evaluate, materialize
from sme_registry.errors import (
    DigestMismatchError,
    MalformedDocumentError,
    MissingDependencyError,
    SpecError,
    UnknownNameError,
)
from sme_registry.evaluation import evaluation_observations, references, regions
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.report import AgentReport
from sme_registry.spec import EvaluationProtocol, ProtocolFile
from tests.evaluation.shown import observations

SPEC = SMESpec(state_dim=4, action_dim=3, complexity=3)
PROTOCOL = EvaluationProtocol(states_per_region=3_000)


def half(observations):
    return np.full((len(observations), 3), 0.5)


def linear(observations):
    return 0.2 + 0.6 * observations[:, :3]


def optimal_of(spec):
    task = materialize(spec)
    return lambda observations: task.optimal_action(observations[:, : spec.state_dim])


@pytest.fixture(scope="module")
def report():
    return evaluate(linear, SPEC, PROTOCOL)


def test_a_policy_is_asked_for_actions_in_the_observations_in_their_order():
    shown = []

    def record(observations):
        shown.append(observations)
        return half(observations)

    protocol = EvaluationProtocol(states_per_region=10_000)  # more than a batch
    evaluate(record, SPEC, protocol)
    assert np.array_equal(np.concatenate(shown), evaluation_observations(SPEC, protocol))
    with pytest.raises(SpecError, match="team"):
        evaluation_observations("Team2-v1", protocol)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
@pytest.mark.parametrize("complexity", [1, 3, 10])
def test_optimal_policy_has_similarity_1_and_regret_0(monkeypatch, backend, complexity):
    if backend == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", backend)
    spec = SPEC.derive(complexity=complexity)
    for region in evaluate(optimal_of(spec), spec, PROTOCOL).regions:
        assert region.similarity == pytest.approx(1.0, abs=1e-9)
        assert region.normalised_regret == pytest.approx(0.0, abs=1e-9)
        assert region.similarity_sd < 1e-9
        assert region.similarity_decay == pytest.approx(0.0, abs=1e-9)


def test_constant_half_has_normalised_regret_of_exactly_1():
    for region in evaluate(half, SPEC, PROTOCOL).regions:
        assert region.normalised_regret == 1.0
        assert [channel.normalised_regret for channel in region.channels] == [1.0] * 3


def test_numbers_are_those_of_the_definition(report):
    task = materialize(SPEC)
    inside = None
    for index, region in enumerate(report.regions):
        o = observations(PROTOCOL, index, SPEC)
        s, a = o[:, :4].astype(np.float64), np.clip(linear(o), 0.0, 1.0).astype(np.float64)
        optimal = task.optimal_action(s)
        similarity = task.similarity(s, a)
        inside = similarity.mean() if inside is None else inside
        missed = np.abs(a - optimal)
        floor = np.abs(0.5 - optimal)
        assert (region.epsilon_low, region.epsilon_high) == PROTOCOL.edges[index]
        assert region.states == 3_000
        assert region.similarity == pytest.approx(similarity.mean(), abs=1e-12)
        assert region.similarity_sd == pytest.approx(similarity.std(ddof=1), abs=1e-12)
        assert region.mae == pytest.approx(missed.mean(), abs=1e-12)
        assert region.normalised_regret == pytest.approx(missed.mean() / floor.mean(), abs=1e-12)
        lost = inside - similarity.mean()
        assert region.similarity_decay == pytest.approx(lost / inside, abs=1e-12)
        assert region.similarity_loss == pytest.approx(100 * lost, abs=1e-9)
        assert region.clipped_share == np.mean((linear(o) < 0) | (linear(o) > 1))
        for channel, mae, half_mae in zip(
            region.channels, missed.mean(axis=0), floor.mean(axis=0), strict=True
        ):
            assert channel.mae == pytest.approx(mae, abs=1e-12)
            assert channel.normalised_regret == pytest.approx(mae / half_mae, abs=1e-12)


def test_references_stand_in_their_known_order_within_distribution(report):
    inside = {name: rows[0].normalised_regret for name, rows in report.references.items()}
    assert tuple(inside) == references.NAMES
    assert inside["optimal"] == 0.0
    assert 0.0 < inside["linear_least_squares"] < inside["best_constant"] <= 1.0
    assert inside["constant_half"] == 1.0 < inside["uniform_random"]


def test_references_have_every_region(report):
    edges = [(region.epsilon_low, region.epsilon_high) for region in report.regions]
    for rows in report.references.values():
        assert [(row.epsilon_low, row.epsilon_high) for row in rows] == edges
        assert all(row.clipped_share == 0.0 for row in rows)


def test_the_same_seed_gives_the_same_report_and_another_seed_another(report):
    assert evaluate(linear, SPEC, PROTOCOL) == report
    other = evaluate(linear, SPEC, EvaluationProtocol(states_per_region=3_000, seed=1))
    assert other.regions[0].similarity != report.regions[0].similarity
    assert other.regions[0].similarity == pytest.approx(report.regions[0].similarity, abs=0.02)


def numbers(report):
    for rows in (report.regions, *report.references.values()):
        for row in rows:
            plain = row.to_dict()
            yield from (plain[key] for key in plain if key not in ("name", "channels"))
            for channel in plain["channels"]:
                yield from channel.values()


@pytest.mark.parametrize("rows", [1_000, 997, 100_000])
def test_batches_of_any_size_give_the_same_numbers(monkeypatch, report, rows):
    monkeypatch.setattr(regions, "BATCH_ROWS", rows)
    monkeypatch.setattr(references, "FIT_STATES", 2**16)
    other = evaluate(linear, SPEC, PROTOCOL)
    assert list(numbers(other)) == pytest.approx(list(numbers(report)), abs=1e-11)


def test_the_fit_sees_as_many_states_whatever_the_batches(monkeypatch):
    monkeypatch.setattr(references, "FIT_STATES", 1_500)
    expected = list(numbers(evaluate(linear, SPEC, PROTOCOL)))
    monkeypatch.setattr(regions, "BATCH_ROWS", 400)
    assert list(numbers(evaluate(linear, SPEC, PROTOCOL))) == pytest.approx(expected, abs=1e-11)


def test_back_ends_agree(monkeypatch, report):
    pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", "numpy")
    plain = evaluate(linear, SPEC, PROTOCOL)
    assert "numba" not in plain.versions
    assert "numba" in report.versions
    assert list(numbers(plain)) == pytest.approx(list(numbers(report)), abs=1e-11)


def test_progress_runs_from_the_first_batch_to_all_states(monkeypatch):
    monkeypatch.setattr(regions, "BATCH_ROWS", 1_000)
    seen = []
    evaluate(half, SPEC, PROTOCOL, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(done, 18_000) for done in range(1_000, 18_001, 1_000)]


@pytest.mark.parametrize("team", [None, {"agents": [{"action_dim": 3}] * 2}])
def test_memory_does_not_grow_with_the_number_of_states(monkeypatch, team):
    import tracemalloc

    spec = SPEC if team is None else SPEC.derive(action_dim=6, team=team)

    def peak(states):
        protocol = EvaluationProtocol(states_per_region=states, epsilons=(0.5,))
        tracemalloc.start()
        evaluate(half, spec, protocol)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    monkeypatch.setattr(regions, "BATCH_ROWS", 500)
    monkeypatch.setattr(references, "FIT_STATES", 500)
    peak(2_000)  # what is allocated once
    assert peak(20_000) < 1.1 * peak(2_000)


@pytest.mark.parametrize("protocol", ["quick-v1", "quick", "specs/protocols/quick-v1.json"])
def test_a_protocol_goes_by_its_name_or_its_path(protocol):
    quick = ProtocolFile.read("specs/protocols/quick-v1.json").protocol
    assert evaluate(half, SPEC, protocol).protocol == quick


def test_the_default_protocol_is_the_papers():
    default = inspect.signature(evaluate).parameters["protocol"].default
    paper = sme_registry.evaluation.resolve_protocol(default)
    assert paper == EvaluationProtocol(states_per_region=50_000, epsilons=(0.2, 0.4, 0.6, 0.8, 1.0))


def test_an_unknown_protocol_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownNameError, match="Did you mean 'paper-v1'"):
        evaluate(half, SPEC, "papper-v1")
    with pytest.raises(MalformedDocumentError, match="cannot be read"):
        evaluate(half, SPEC, "nowhere/protocol.json")
    with pytest.raises(SpecError, match="must be a protocol, its name or its path"):
        evaluate(half, SPEC, 7)


def test_a_report_survives_being_written_and_read(report, tmp_path):
    path = report.write(tmp_path / "new" / "report.json")
    again = EvaluationReport.read(path)
    assert again == report
    assert again.to_dict() == report.to_dict()


def test_a_report_holds_task_and_protocol_whole_with_their_digests(report):
    plain = report.to_dict()
    assert plain["spec"] == SPEC.to_dict()
    assert plain["spec_digest"] == SPEC.digest
    assert plain["protocol"] == PROTOCOL.to_dict()
    assert plain["protocol_digest"] == PROTOCOL.digest
    assert [region["name"] for region in plain["regions"]] == [
        "WD", "OOD 1", "OOD 2", "OOD 3", "OOD 4", "OOD 5",
    ]  # fmt: skip
    assert {"python", "numpy", "scipy", "gymnasium", "sme_registry"} <= plain["versions"].keys()


@pytest.mark.parametrize("what", ["spec", "protocol"])
def test_a_report_whose_digest_is_of_something_else_is_refused(report, tmp_path, what):
    path = tmp_path / "report.json"
    changed = report.model_copy(update={f"{what}_digest": "sha256:" + "0" * 64})
    changed.write(path)
    with pytest.raises(DigestMismatchError, match=f"{what}_digest"):
        EvaluationReport.read(path)


def test_a_report_with_an_unknown_or_missing_field_is_refused(report):
    with pytest.raises(SpecError, match="unknown field"):
        EvaluationReport.from_dict({**report.to_dict(), "extra": 1})
    plain = report.to_dict()
    del plain["regions"][0]["mae"]
    with pytest.raises(SpecError, match="mae: missing"):
        EvaluationReport.from_dict(plain)


def test_regret_and_decay_over_regions_are_those_of_the_definition(report):
    inside, *shells = (region.normalised_regret for region in report.regions)
    assert report.wd_regret == inside
    assert report.ood_regret == pytest.approx(np.mean(shells), abs=1e-15)
    assert report.ood_decay == report.ood_regret - inside
    alone = report.model_copy(update={"regions": report.regions[:1]})
    assert np.isnan(alone.ood_regret)
    assert np.isnan(alone.ood_decay)


def test_the_frame_has_one_row_for_each_policy_and_region(report):
    pytest.importorskip("pandas")
    frame = report.to_frame()
    assert list(frame.columns) == [
        "policy", "reference", "agent", "region", "epsilon_low", "epsilon_high", "states",
        "similarity", "similarity_sd", "mae", "normalised_regret", "similarity_decay",
        "similarity_loss", "clipped_share",
    ]  # fmt: skip
    assert len(frame) == 6 * 6
    mine = frame[~frame["reference"]]
    assert list(mine["region"]) == [region.name for region in report.regions]
    assert list(mine["mae"]) == [region.mae for region in report.regions]
    half = frame[frame["policy"] == "constant_half"]
    assert list(half["normalised_regret"]) == [1.0] * 6


def test_a_teams_frame_has_rows_for_each_agent():
    pytest.importorskip("pandas")
    spec = sme_registry.load("Team2")
    report = evaluate(reference_policy("linear", spec), spec, PROTOCOL)
    frame = report.to_frame()
    assert len(frame) == 6 * 6 * 3
    own = frame[(frame["agent"] == "agent_1") & (frame["policy"] == "best_constant")]
    expected = report.agents["agent_1"].references["best_constant"]
    assert list(own["normalised_regret"]) == [region.normalised_regret for region in expected]


def test_a_frame_without_pandas_names_the_extra(report, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[studies\]"):
        report.to_frame()


def test_a_csv_file_has_the_frame_and_does_not_need_pandas(report, tmp_path, monkeypatch):
    pandas = pytest.importorskip("pandas")
    frame = report.to_frame()
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        path = report.to_csv(tmp_path / "report.csv")
    pandas.testing.assert_frame_equal(pandas.read_csv(path, keep_default_na=False), frame)


def test_a_notebook_shows_a_reports_table_and_a_line_elsewhere(report):
    assert len(repr(report)) < 150
    assert f"WD regret {report.wd_regret:.3f}" in repr(report)
    html = report._repr_html_()
    rows = html.split("<tr")[1:]
    assert len(rows) == 1 + sum(row is not None for row in report.table().rows)
    assert all(row.count("</td>") == 7 for row in rows[1:])
    assert f"{report.regions[5].normalised_regret:.3f}" in html
    escaped = report.model_copy(update={"policy": "<b>[bold]"})._repr_html_()
    assert "&lt;b&gt;[bold] on SME" in escaped
    assert "<b>[bold]" not in escaped


def test_a_notebook_draws_a_reports_curve_beside_the_references(report):
    chart = ElementTree.fromstring(report.chart())
    labels = {each.text for each in chart.iter("text")}
    assert {"policy", "optimal", "linear (LSQ)", "constant ½", "WD", "OOD 5"} <= labels
    last = f"{report.regions[5].normalised_regret:.2f}"
    assert f", {last}" in chart.attrib["aria-label"].split("policy: ")[1]
    assert report.chart() in report._repr_html_()
    assert len(report._repr_html_().encode()) < 20_000


def test_the_curve_of_a_large_team_is_short_and_names_the_worst_agent(report):
    agent = AgentReport(regions=report.regions, references=report.references)
    agents = {f"agent_{i}": agent for i in range(256)}
    worse = [each.model_copy(update={"normalised_regret": 3.0}) for each in report.regions]
    agents["left-arm_of_the_team"] = agent.model_copy(update={"regions": worse})
    chart = report.model_copy(update={"agents": agents}).chart()
    assert len(chart.encode()) < 8_000
    labels = {each.text for each in ElementTree.fromstring(chart).iter("text")}
    assert {"left-arm_…, worst", "team"} <= labels


def test_printing_a_report_shows_its_table(report):
    text = str(report)
    rows = [line.split() for line in text.splitlines()]
    assert ["optimal", *["1.000"] * len(report.regions)] in rows
    assert "\x1b" not in text


def rendered(report):
    console = Console(width=80, file=io.StringIO(), force_terminal=True, color_system=None)
    console.print(report.table())
    return console.file.getvalue()


def test_the_table_fits_80_columns_and_shows_references_beside_the_policy(report):
    text = rendered(report)
    assert "…" not in text
    for wanted in ("OOD 5", "linear (LSQ)", "constant ½", "random", "not comparable"):
        assert wanted in text
    assert f"{report.regions[0].similarity:.3f}" in text
    assert f"{report.references['linear_least_squares'][5].normalised_regret:.3f}" in text


def test_the_table_goes_by_the_catalogues_name_where_there_is_one_and_shows_the_digest():
    named, derived = SMESpec(), SMESpec(seed=12345)
    for spec, title in ((named, "SME/Default-v1"), (derived, f"SME/{derived.content_name}")):
        text = rendered(evaluate(optimal_of(spec), spec, PROTOCOL, name="mine"))
        assert f"mine on {title} (S=8, A=4, L=1)" in text
        assert spec.digest in text


def test_a_policys_name_is_not_read_as_markup(report):
    text = rendered(evaluate(half, SPEC, "quick-v1", name="[red]x[/blue]"))
    assert "[red]x[/blue]" in text
