"""What a board checks of a submission: each code, and the order of them."""

import datetime

import pytest
from typer.testing import CliRunner

from leaderboard.admission import check_submission
from leaderboard.cli import app
from leaderboard.cli.submit import find_suite
from leaderboard.documents.board import MOST_LISTED, BoardDocument, Limits, refuse_unsubmittable
from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.documents.submission import Submission, check_names
from leaderboard.errors import BoardError, Rejection
from leaderboard.seasons.season import SeasonClass
from leaderboard.store import Store
from sme_registry import EvaluationProtocol
from sme_registry.errors import SpecError
from sme_registry.spec import SuiteFile, catalogue
from tests.leaderboard.conftest import document_of, plain_submission, suite_of
from tests.leaderboard.seasons.sealing import tiny_season

SUITE = suite_of(A=(2, {}), B=(1, {"complexity": 2}))
LIMITS = Limits(artefact_bytes=1000, age_days=14)
BOARD = document_of(SUITE, suite_name="two-v1", key="ab" * 32, limits=LIMITS)
A0, A1, B0 = (spec.digest for spec in SUITE.instances)
NOW = datetime.datetime(2026, 11, 21, 12, tzinfo=datetime.UTC)


def policy(number, size=100):
    return {"sha256": f"sha256:{number:064x}", "size": size}


def run(spec, seed=0, artefact=None):
    return {"spec": spec, "seed": seed, "steps": 10, "artefact": artefact}


RUNS = [run(A0, 0, policy(1)), run(A1, 0, policy(2)), run(B0, 0, policy(3, size=1000))]


def submission(**changes):
    """A submission that passes, but for what is changed; `method__name` is the method's name."""
    started = {"A": 2, "B": 1}
    plain = plain_submission(BOARD, RUNS, "cd" * 32, runs_started=started, training={})
    for field, value in changes.items():
        *outer, name = field.split("__")
        into = plain[outer[0]] if outer else plain
        into[name] = value
    return Submission.from_dict(plain)


def refused(expected, match, **changes):
    with pytest.raises(Rejection, match=match) as caught:
        check_submission(BOARD, submission(**changes), NOW)
    assert caught.value.code == expected


def accepted(**changes):
    check_submission(BOARD, submission(**changes), NOW)


NAMES = ("method__name", "method__version", "method__family", "submitter__name")
UNSAFE_NAMES = [
    "<script>alert(1)</script>",
    "+1",
    " PPO",
    "P\tO",
    "PPO\u202eOPP",
    "P\u200bPO",
    "РРО",  # Cyrillic
    "a\\b",
]


@pytest.mark.parametrize("field", NAMES)
def test_only_a_name_that_is_safe_to_show_passes(field):
    match = f"{field.replace('__', '.')}='.*': must begin with a letter"
    for name in UNSAFE_NAMES:
        refused("unsafe_name", match, **{field: name})
    for name in ("PPO", "2", "A Lab (Berlin)", "v1.0-rc_2+x", "x" * 80):
        accepted(**{field: name})
    # The board's own submissions are checked like any other.
    own = {"submitter__key": BOARD.key}
    refused("unsafe_name", match, **{field: "<b>", **own})
    accepted(**own)


@pytest.mark.parametrize(
    ("field", "names"),
    [
        (
            "submitter__name",
            ["the board", "The Board", "the-board", "the board.", "T H E.board", "the b0ard"],
        ),
        ("method__family", ["Reference.", "re-ference", "REFERENCE"]),
    ],
)
def test_what_the_boards_own_rows_are_called_is_the_boards_alone(field, names):
    for name in names:
        match = f"{field.replace('__', '.')}='{name}': reserved for the board's own"
        refused("unsafe_name", match, **{field: name})
        with pytest.raises(Rejection, match=match):
            check_names(submission(**{field: name}))
        accepted(**{field: name, "submitter__key": BOARD.key})
        accepted(**{field: f"{name} 2"})


TEXTS = ("training__library", "training__hyperparameters", "training__hardware", "statement")


@pytest.mark.parametrize("field", TEXTS)
def test_a_text_may_have_line_breaks_and_any_script_but_no_control_characters(field):
    for letter in ["\x00", "\x1b", "\r", "\x7f", "\x85", "\u202e", "\u2066", "\u2028"]:
        refused("unsafe_name", f"{field.replace('__', '.')}: contains", **{field: f"a{letter}b"})
    accepted(**{field: "<b>größer</b>\n模型 = 1"})  # pages escape what they show


def test_a_link_has_only_the_characters_of_a_url():
    for code in ['https://a/"onload=', "https://a/<b>", "https://a/`b`", "https://a/b\\c"]:
        refused("unsafe_name", "code='.*': must contain only the characters of a URL", code=code)
    accepted(code="https://example.org/a(b)/c?d=e&f=%20#g")


def test_another_suite_or_the_same_by_another_name_is_refused():
    for other in (
        {"name": "two-v1", "digest": "sha256:" + "0" * 64},
        {"name": "three-v1", "digest": SUITE.digest},
    ):
        match = f"suite={other['name']}, {other['digest']}: must be two-v1, {SUITE.digest}"
        refused("unknown_suite", match, suite=other)


def test_a_time_far_from_the_boards_is_refused():
    for created in ("2026-11-07T12:00:00Z", "2026-11-21T12:10:00Z"):
        accepted(created=created)
    for created, code, match in [
        ("2026-11-07T11:59:59Z", "stale_time", "at most 14 days old"),
        ("0001-01-01T00:00:00Z", "stale_time", "at most 14 days old"),
        ("2026-11-21T12:10:01Z", "stale_time", "at most 10 minutes ahead"),
        ("9999-12-31T23:59:59Z", "stale_time", "at most 10 minutes ahead"),
        ("2026-02-30T00:00:00Z", "schema", "must be an existing time"),
        ("0000-01-01T00:00:00Z", "schema", "must be an existing time"),
    ]:
        refused(code, match, created=created)


def test_a_run_or_a_policy_that_is_listed_twice_on_one_spec_is_refused():
    for twice, match in [
        (run(A1, 0, policy(9)), "runs.3: seed=0: runs.1 has the same"),
        (run(A0, 1, policy(1)), "runs.3: policy=sha256.*1: runs.0 has the same"),
    ]:
        refused("duplicate_run", match, runs=[*RUNS, twice])
    runs = [run(A0, 0, policy(1)), run(A1, 0, policy(1)), run(B0, 0), run(B0, 1)]
    accepted(runs=runs, runs_started={"A": 2, "B": 2})


def test_runs_started_count_all_runs_and_are_at_most_a_thousand():
    failed = [run(A0, 0, policy(1)), run(A1), run(B0), run(B0, 1)]
    for code, started, match, runs in [
        (
            *("missing_run", {"A": 2, "B": 1, "C": 1}),
            *("runs_started.C: must be a class of the suite: A, B", RUNS),
        ),
        ("missing_run", {"A": 2}, "runs_started.B=None: must be at least 1", RUNS),
        ("missing_run", {"A": 1, "B": 1}, "runs_started.A=1: must be at least 2", RUNS),
        ("missing_run", {"A": 2, "B": 1}, "runs_started.B=1: must be at least 2", failed),
        ("schema", {"A": 900, "B": 101}, "runs_started=1001: must be at most 1,000 in t", RUNS),
    ]:
        refused(code, match, runs_started=started, runs=runs)
    accepted(runs_started={"A": 12, "B": 10})
    accepted(runs_started={"A": 900, "B": 100})


def test_runs_without_any_policy_are_refused():
    runs = [run(A0), run(A1), run(B0)]
    refused("missing_run", "none has a policy", runs=runs)


def board_of(instances, **fields):
    return BOARD.model_copy(update={"suite": suite_of(A=(instances, {})), **fields})


def signed_runs(board, count, **changes):
    """The bytes of a submission with so many runs, all alike but for the seed."""
    runs = [
        {"spec": A0, "seed": number, "steps": 10**6, "artefact": policy(number, 10**6)}
        for number in range(count)
    ]
    made = submission(runs=runs, **changes)
    return Signed[Submission](submission=made, signature="0" * 128).to_bytes()


def test_the_most_runs_of_a_submission_fit_and_a_tenth_more_do_not():
    most = MOST_LISTED
    assert len(signed_runs(BOARD, most)) <= MAX_BYTES < len(signed_runs(BOARD, most + most // 10))


def test_a_board_whose_suite_exceeds_a_submission_is_refused(tmp_path):
    most = MOST_LISTED
    refuse_unsubmittable(board_of(most))
    with pytest.raises(BoardError, match=rf"suite=two-v1: .* {most + 1} runs.*at most {most},"):
        refuse_unsubmittable(board_of(most + 1))
    with pytest.raises(BoardError, match="300 in each class and as many on each instance"):
        refuse_unsubmittable(board_of(1, runs_to_rank=300))
    with pytest.raises(BoardError, match="needs 260 runs"):
        Store.create(
            tmp_path / "board",
            title="The paper's",
            suite_name="paper-ablations-v1",
            suite=catalogue.find(SuiteFile, "paper-ablations-v1").suite,
            protocol_name="paper-v1",
            protocol=EvaluationProtocol(),
        )
    assert not list(tmp_path.iterdir())


FAULTS = [
    ("unsafe_name", {"method__name": "<b>"}, "method.name"),
    ("stale_time", {"created": "2020-01-01T00:00:00Z"}, "14 days"),
    ("unknown_suite", {"suite": {"name": "x", "digest": "sha256:" + "0" * 64}}, "suite=x"),
    ("unknown_spec", [run("sha256:" + "1" * 64)], r"runs.3: spec=.*3 instances \(`sme show two"),
    ("duplicate_run", [run(A0, 5), run(A0, 5)], "seed=5"),
    ("missing_run", {"runs_started": {"A": 100}}, "runs_started.B=None"),
    ("too_large", [run(A0, 6, policy(8, size=1001))], "size=1,001"),
]


@pytest.mark.parametrize("first", range(len(FAULTS)))
def test_the_first_of_several_faults_is_reported(first):
    changes, runs = {}, list(RUNS)
    for _, fault, _ in FAULTS[first:]:
        if isinstance(fault, dict):
            changes.update(fault)
        else:
            runs += fault
    changes.setdefault("runs_started", {"A": 100, "B": 1})
    code, _, match = FAULTS[first]
    refused(code, match, runs=runs, **changes)


# Suites that no board scores

MORE = {
    "safety": {"tightness": 0.2},
    "observation": {"mixing": "orthogonal"},
    "shaping": {"scale": 0.5},
    "noise": {"reward": 0.1},
}


@pytest.mark.parametrize("field", MORE)
def test_boards_and_seasons_refuse_classes_with_more_than_a_plain_task(field):
    plain, setting = BOARD.to_dict(), {field: MORE[field]}
    BoardDocument.from_dict(plain)
    suite = suite_of(Plain=(1, {}), Other=(1, setting))
    with pytest.raises(SpecError, match=rf"suite: has classes .*{field}.* \(Other\), and a"):
        BoardDocument.from_dict({**plain, "suite": suite.to_dict()})
    member = {**tiny_season().to_dict()["classes"][0]}
    with pytest.raises(SpecError, match=f"{field}: must be null in a sealed season"):
        SeasonClass.from_dict({**member, "setting": {**member["setting"], **setting}})


@pytest.mark.parametrize("name", ["safety", "representation"])
def test_commands_refuse_the_suites_of_the_catalogue_that_boards_do_not_score(name, tmp_path):
    with pytest.raises(SpecError, match="safety, observation, shaping or noise"):
        find_suite(name)
    result = CliRunner().invoke(app, ["init", f"{tmp_path}/board", "--suite", name])
    assert result.exit_code == 2, result.output
    assert "Choose a suite without them" in " ".join(result.stderr.split())
