"""Reports of every kind of task: alike in any batches, and as files, tables, frames and charts."""

import functools
import io
import json
import operator
import sys
import tracemalloc

import numpy as np
import pytest
from rich.console import Console

from sme_registry import EvaluationReport, SMESpec, evaluate, plots
from sme_registry.errors import DigestMismatchError, MissingDependencyError, SpecError
from sme_registry.evaluation import references, regions
from sme_registry.evaluation.report import as_text
from sme_registry.spec import EvaluationProtocol
from tests.evaluation.kinds import (
    DISTRACTORS,
    KINDS,
    NAMES,
    PLAIN,
    PROTOCOL,
    SAFE,
    SMALL,
    half,
    numbers,
    optimal_of,
    report_of,
)

every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture
def report():
    return report_of("plain")


# Numbers


@every_kind
@pytest.mark.parametrize("rows", [997, 100_000])
def test_batches_of_any_size_give_the_same_numbers(monkeypatch, kind, rows):
    expected = numbers(report_of(kind))
    monkeypatch.setattr(regions, "BATCH_ROWS", rows)
    monkeypatch.setattr(references, "FIT_STATES", 2**16)
    assert numbers(evaluate(*KINDS[kind], PROTOCOL)) == pytest.approx(expected, abs=1e-11)


@every_kind
def test_back_ends_agree(monkeypatch, kind):
    pytest.importorskip("numba")
    compiled = report_of(kind)
    monkeypatch.setenv("SME_BACKEND", "numpy")
    plain = evaluate(*KINDS[kind], PROTOCOL)
    assert "numba" not in plain.versions
    assert "numba" in compiled.versions
    assert numbers(plain) == pytest.approx(numbers(compiled), abs=1e-11)


@every_kind
def test_the_same_seed_gives_the_same_report_and_another_seed_another(kind):
    report = report_of(kind)
    assert numbers(evaluate(*KINDS[kind], PROTOCOL)) == numbers(report)
    other = evaluate(*KINDS[kind], EvaluationProtocol(states_per_region=2_000, seed=1))
    assert other.regions[0].similarity != report.regions[0].similarity
    assert other.regions[0].similarity == pytest.approx(report.regions[0].similarity, abs=0.02)


@pytest.mark.parametrize(
    "spec",
    [
        PLAIN,
        PLAIN.derive(action_dim=6, team={"agents": [{"action_dim": 3}] * 2}),
        PLAIN.derive(observation={"distractors": 400}),
    ],
    ids=["plain", "team", "distractors"],
)
def test_memory_does_not_grow_with_the_number_of_states(monkeypatch, spec):
    def peak(states):
        protocol = EvaluationProtocol(states_per_region=states, epsilons=(0.5,))
        tracemalloc.start()
        try:
            evaluate(half(3), spec, protocol)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    monkeypatch.setattr(regions, "BATCH_ROWS", 100)
    monkeypatch.setattr(references, "FIT_STATES", 100)
    peak(500)  # what is allocated once
    assert peak(4_000) < 1.1 * peak(500)


def test_regret_and_decay_over_regions_are_those_of_the_definition(report):
    inside, *shells = (region.normalised_regret for region in report.regions)
    assert report.wd_regret == inside
    assert report.ood_regret == pytest.approx(np.mean(shells), abs=1e-15)
    wd, *outside = (region.similarity for region in report.regions)
    assert report.ood_decay == pytest.approx(1 - np.mean(outside) / wd, abs=1e-15)
    alone = report.model_copy(update={"regions": report.regions[:1]})
    assert np.isnan(alone.ood_regret)
    assert np.isnan(alone.ood_decay)


# Documents


@every_kind
def test_a_report_survives_being_written_and_read(kind, tmp_path):
    report = report_of(kind)
    again = EvaluationReport.read(report.write(tmp_path / "new" / "report.json"))
    assert again == report
    assert again.to_dict() == report.to_dict()
    assert tuple(again.agents) == (NAMES if kind == "team" else ())


def test_a_report_holds_task_and_protocol_whole_and_no_field_of_other_kinds(report):
    plain = report.to_dict()
    assert list(plain) == [
        "schema_version", "policy", "action_range", "spec", "spec_digest", "protocol",
        "protocol_digest", "regions", "references", "versions",
    ]  # fmt: skip
    assert (plain["spec"], plain["spec_digest"]) == (PLAIN.to_dict(), PLAIN.digest)
    assert (plain["protocol"], plain["protocol_digest"]) == (PROTOCOL.to_dict(), PROTOCOL.digest)
    names = [region["name"] for region in plain["regions"]]
    assert names == ["WD", "OOD 1", "OOD 2", "OOD 3", "OOD 4", "OOD 5"]
    assert tuple(plain["references"]) == references.NAMES
    assert {"python", "numpy", "scipy", "gymnasium", "sme_registry"} <= plain["versions"].keys()


@pytest.mark.parametrize("what", ["spec", "protocol"])
def test_a_report_whose_digest_is_of_something_else_is_refused(report, tmp_path, what):
    changed = report.model_copy(update={f"{what}_digest": "sha256:" + "0" * 64})
    with pytest.raises(DigestMismatchError, match=f"{what}_digest"):
        EvaluationReport.read(changed.write(tmp_path / "report.json"))


@pytest.mark.parametrize(
    ("kind", "missing", "message"),
    [
        ("plain", ["regions", 0, "mae"], "mae: missing"),
        ("safe", ["safety", "references", "shrunk_optimal"], "safety.references: is of"),
        ("safe", ["safety", "references", "linear"], "safety.references: is of"),
        ("safe", ["safety", "references", "optimal", -1], "references.optimal: is of WD, .*: must"),
        ("safe", ["safety", "regions", -1], "regions: is of WD, .*OOD 4: must be of WD, .*OOD 5"),
        ("safe", ["safety"], "safety: is missing"),
        ("distracted", ["observation", "sensitivity", -1], "observation.sensitivity: is of"),
        (
            "distracted",
            ["observation", "distractor_regions", -1],
            "observation.distractor_regions: is of",
        ),
    ],
)
def test_a_stored_report_that_lacks_something_is_refused(kind, missing, message):
    document = report_of(kind).to_dict()
    *path, last = missing
    functools.reduce(operator.getitem, path, document).pop(last)
    with pytest.raises(SpecError, match=message):
        EvaluationReport.from_dict(document)


def test_a_stored_report_may_have_references_of_another_version():
    document = report_of("safe").to_dict()
    for scores in (document["references"], document["safety"]["references"]):
        scores["earlier_name"] = scores.pop("shrunk_optimal")
        del scores[references.NAMES[-1]]  # younger than the report
    report = EvaluationReport.from_dict(document)
    assert "similarity" in str(report)
    shown = everything(report)
    assert shown.count("earlier_name") == 6  # two of errors, four of safety
    assert plots.reward_against_cost(report)


@every_kind
def test_a_report_of_version_1_is_read_under_todays_names(kind):
    report = report_of(kind)
    today = json.dumps(report.to_dict() | {"schema_version": 1, "policy": "mine"})
    for old, new in references.OLD_NAMES.items():
        today = today.replace(f'"{new}": ', f'"{old}": ')
    old = json.loads(today.replace('"sensitivity": ', '"invariance": '))
    assert "linear_least_squares" in old["references"]
    read = EvaluationReport.from_dict(old)
    assert read == report.model_copy(update={"policy": "mine"})
    assert read.schema_version == 2


def test_a_stored_report_with_more_than_its_task_has_is_refused(report):
    with pytest.raises(SpecError, match="unknown field"):
        EvaluationReport.from_dict(report.to_dict() | {"extra": 1})
    plain = SAFE.derive(safety=None)
    document = report_of("safe").to_dict()
    document |= {"spec": plain.to_dict(), "spec_digest": plain.digest}
    with pytest.raises(SpecError, match="safety: is present, but the task is one without safety"):
        EvaluationReport.from_dict(document)


# Frames


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
    constant = frame[frame["policy"] == "constant"]
    assert list(constant["normalised_regret"]) == [1.0] * 6


def test_frames_have_agents_safety_and_distractors():
    pytest.importorskip("pandas")
    team = report_of("team")
    frame = team.to_frame()
    assert len(frame) == 6 * 6 * 4
    own = frame[(frame["agent"] == "right_0") & (frame["policy"] == "best_constant")]
    expected = team.agents["right_0"].references["best_constant"]
    assert list(own["normalised_regret"]) == [region.normalised_regret for region in expected]

    safe = report_of("safe")
    frame = safe.to_frame()
    row = frame[(frame.policy == "shrunk_optimal") & (frame.region == "OOD 2")].iloc[0]
    assert row.cost == 0.0
    assert row.safe_regret == safe.safety.references["shrunk_optimal"][2].safe_regret

    observed = report_of("distracted")
    frame = observed.to_frame()
    own = frame[~frame.reference].set_index("region")
    assert own.loc["WD", "sensitivity"] == observed.observation.sensitivity[0].sensitivity
    outside = observed.observation.distractor_regions[1]
    assert own.loc["d-OOD 2", "normalised_regret"] == outside.normalised_regret
    assert (frame[frame.reference].sensitivity == 0.0).all()


def test_a_frame_needs_pandas_and_a_csv_file_does_not(report, tmp_path, monkeypatch):
    pandas = pytest.importorskip("pandas")
    frame = report.to_frame()
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        path = report.to_csv(tmp_path / "report.csv")
        with pytest.raises(MissingDependencyError, match=r"pip install .*\[studies\]"):
            report.to_frame()
    pandas.testing.assert_frame_equal(pandas.read_csv(path, keep_default_na=False), frame)


# Tables and charts


def rendered(report):
    console = Console(width=80, file=io.StringIO(), force_terminal=True, color_system=None)
    console.print(report.table())
    return console.file.getvalue()


def everything(report):
    return "\n".join(map(as_text, report.tables(details=True)))


def test_the_table_fits_80_columns_and_shows_references_beside_the_policy(report):
    text = rendered(report)
    assert "…" not in text
    assert "\x1b" not in str(report)
    for wanted in ("OOD 5", "linear", "constant ½", "random", "not comparable"):
        assert wanted in text
    assert f"{report.regions[0].similarity:.3f}" in text
    assert f"{report.references['linear'][5].normalised_regret:.3f}" in text


def test_the_table_of_a_team_has_three_lines_for_each_agent():
    report = report_of("team")
    text = rendered(report)
    assert "…" not in text
    before, after = text.split("actions clipped")
    for name, agent in report.agents.items():
        assert name not in before
        block = after[after.index(name) :].splitlines()[:3]
        linear = agent.references["linear"]
        assert f"{agent.regions[2].similarity:.3f}" in block[0]
        assert f"{agent.regions[2].normalised_regret:.3f}" in block[1]
        assert f"{linear[2].normalised_regret:.3f}" in block[2]


def test_tables_show_safety_and_distractors():
    safe, text = report_of("safe"), everything(report_of("safe"))
    for heading in ("cost", "violating share", "safe regret", "price of", "safe projection"):
        assert heading in text
    assert f"{safe.safety.regions[0].safe_regret:.3f}" in text
    text = everything(report_of("distracted"))
    assert f"{DISTRACTORS} distractors" in text
    assert "sensitivity" in text
    assert "\ncost" in str(safe)
    assert "sensitivity" in str(report_of("distracted"))
    assert "safe regret" not in str(safe)


@pytest.mark.parametrize("spec", [SMESpec(), SMESpec(seed=12345)])
def test_the_table_goes_by_the_catalogues_name_where_there_is_one_and_shows_the_digest(spec):
    title = "SME/Default-v1" if spec == SMESpec() else f"SME/{spec.content_name}"
    text = rendered(evaluate(optimal_of(spec), spec, SMALL, name="mine"))
    assert f"mine on {title} (S=8, A=4, L=1)" in text
    assert spec.digest in text


def test_a_notebook_shows_a_reports_table_and_a_line_elsewhere(report):
    assert len(repr(report)) < 150
    assert f"WD regret {report.wd_regret:.3f}" in repr(report)
    html = report._repr_html_()
    rows = html.split("<tr")[1:]
    assert len(rows) == 1 + len(report.tables()[0].grid.rows)
    assert all(row.count("</td>") == 7 for row in rows[1:])
    assert f"{report.regions[5].normalised_regret:.3f}" in html
    escaped = report.model_copy(update={"policy": "<b>[bold]"})._repr_html_()
    assert "&lt;b&gt;[bold] on SME" in escaped
    assert "<b>[bold]" not in escaped
    assert len(html.encode()) < 20_000
