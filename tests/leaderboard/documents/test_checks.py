"""What a board checks of a submission: each code, and the order of them."""

from __future__ import annotations

import datetime

import pytest

from leaderboard.documents.board import BoardDocument, Limits
from leaderboard.documents.checks import (
    check_names,
    check_runs,
    check_submission,
    most_runs,
    refuse_unsubmittable,
)
from leaderboard.documents.submission import MAX_BYTES, SignedSubmission, Submission
from leaderboard.errors import BoardError, Rejection
from leaderboard.intake import submit_references
from leaderboard.store import Store
from sme_registry import EvaluationProtocol
from sme_registry.spec import Suite, SuiteFile, catalogue
from tests.leaderboard.conftest import tiny_board

SETTING = {"state_dim": 2, "action_dim": 1}
SUITE = Suite.from_dict(
    {
        "classes": [
            {"name": "A", "setting": SETTING, "seeds": [0, 1]},
            {"name": "B", "setting": {**SETTING, "complexity": 2}, "seeds": [0]},
        ]
    }
)
BOARD = BoardDocument(
    title="A board",
    suite_name="two-v1",
    suite=SUITE,
    protocol_name="paper-v1",
    protocol=EvaluationProtocol(),
    key="ab" * 32,
    limits=Limits(artefact_bytes=1000, age_days=14),
)
A0, A1, B0 = (spec.digest for spec in SUITE.instances)
NOW = datetime.datetime(2026, 11, 21, 12, tzinfo=datetime.UTC)


def policy(number, size=100):
    return {"sha256": f"sha256:{number:064x}", "size": size}


def run(spec, seed=0, artefact=None):
    return {"spec": spec, "seed": seed, "steps": 10, "artefact": artefact}


RUNS = [run(A0, 0, policy(1)), run(A1, 0, policy(2)), run(B0, 0, policy(3))]


def submission(**changes):
    """A submission that passes, but for what is changed; `method__name` is the method's name."""
    plain = {
        "suite": BOARD.suite_reference.to_dict(),
        "method": {"name": "PPO", "version": "1.0", "family": "PPO", "knowledge": "generic"},
        "submitter": {"name": "A Lab", "key": "cd" * 32},
        "created": "2026-11-21T12:00:00Z",
        "runs": RUNS,
        "runs_started": {"A": 2, "B": 1},
        "training": {},
    }
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


def test_a_submission_for_this_board_passes():
    accepted()


NAMES = ("method__name", "method__version", "method__family", "submitter__name")


@pytest.mark.parametrize("field", NAMES)
@pytest.mark.parametrize(
    "name",
    [
        "<script>alert(1)</script>",
        "=1+1",
        "@SUM(A1)",
        "-2+3",
        "+1",
        " PPO",
        "PPO ",
        "P  O",
        "PPO\n",
        "P\tO",
        "PPO\x00",
        "PPO\u202eOPP",
        "P\u200bPO",
        "РРО",  # Cyrillic
        "a&b",
        "a\\b",
        "a/b",
        "{{7*7}}",
    ],
)
def test_a_name_that_is_unsafe_to_show_is_refused(field, name):
    refused(
        "unsafe_name", f"{field.replace('__', '.')}='.*': must begin with a letter", **{field: name}
    )


@pytest.mark.parametrize("field", NAMES)
@pytest.mark.parametrize("name", ["PPO", "2", "A Lab (Berlin)", "v1.0-rc_2+x", "x" * 80])
def test_a_plain_name_passes(field, name):
    accepted(**{field: name})


@pytest.mark.parametrize(
    ("field", "name"),
    [
        ("submitter__name", "the board"),
        ("submitter__name", "The Board"),
        ("submitter__name", "the-board"),
        ("submitter__name", "the board."),
        ("submitter__name", "T H E.board"),
        ("submitter__name", "the b0ard"),
        ("method__family", "Reference."),
        ("method__family", "re-ference"),
        ("method__family", "reference"),
        ("method__family", "REFERENCE"),
    ],
)
def test_what_the_boards_own_rows_are_called_is_the_boards_alone(field, name):
    match = f"{field.replace('__', '.')}='{name}': reserved for the board's own"
    refused("unsafe_name", match, **{field: name})
    with pytest.raises(Rejection, match=match):
        check_names(submission(**{field: name}))
    accepted(**{field: name, "submitter__key": BOARD.key})
    accepted(**{field: f"{name} 2"})


def test_a_reference_row_signed_by_another_key_is_refused(tmp_path):
    with tiny_board(tmp_path / "board") as store:
        for id in submit_references(store):
            own = store.submission(id).submission
            check_submission(store.document, own, datetime.datetime.now(datetime.UTC))
            for field in ("submitter.name", "method.family"):
                plain = own.to_dict()
                plain["submitter"]["key"] = "cd" * 32
                if field == "method.family":
                    plain["submitter"]["name"] = "A Lab"
                with pytest.raises(Rejection, match=f"^unsafe_name: {field}"):
                    check_names(Submission.from_dict(plain), store.document.key)


TEXTS = ("training__library", "training__hyperparameters", "training__hardware", "statement")


@pytest.mark.parametrize("field", TEXTS)
@pytest.mark.parametrize(
    "letter", ["\x00", "\x1b", "\r", "\x7f", "\x85", "\u202e", "\u2066", "\u2028"]
)
def test_control_characters_in_a_text_are_refused(field, letter):
    refused("unsafe_name", f"{field.replace('__', '.')}: contains", **{field: f"a{letter}b"})


@pytest.mark.parametrize("field", TEXTS)
def test_a_text_may_have_line_breaks_and_any_script(field):
    accepted(**{field: "<b>größer</b>\n模型 = 1"})  # pages escape what they show


@pytest.mark.parametrize(
    "code", ['https://a/"onload=', "https://a/<b>", "https://a/`b`", "https://a/b\\c"]
)
def test_a_link_of_other_characters_is_refused(code):
    refused("unsafe_name", "code='.*': must contain only the characters of a URL", code=code)


def test_a_link_passes():
    accepted(code="https://example.org/a(b)/c?d=e&f=%20#g")


def test_another_suite_is_refused():
    other = {"name": "two-v1", "digest": "sha256:" + "0" * 64}
    refused("unknown_suite", "suite=two-v1, sha256:000.*: must be two-v1, sha256:", suite=other)


def test_a_suite_by_another_name_is_refused():
    other = {"name": "three-v1", "digest": SUITE.digest}
    refused("unknown_suite", "suite=three-v1, sha256:.*: must be two-v1, sha256:", suite=other)


@pytest.mark.parametrize("created", ["2026-11-07T12:00:00Z", "2026-11-21T12:10:00Z"])
def test_a_time_at_the_limits_passes(created):
    accepted(created=created)


@pytest.mark.parametrize(
    ("created", "match"),
    [
        ("2026-11-07T11:59:59Z", "at most 14 days old"),
        ("0001-01-01T00:00:00Z", "at most 14 days old"),
        ("2026-11-21T12:10:01Z", "at most 10 minutes ahead"),
        ("9999-12-31T23:59:59Z", "at most 10 minutes ahead"),
    ],
)
def test_a_time_far_from_the_boards_is_refused(created, match):
    refused("stale_time", match, created=created)


@pytest.mark.parametrize("created", ["2026-02-30T00:00:00Z", "0000-01-01T00:00:00Z"])
def test_a_time_that_does_not_exist_is_refused(created):
    refused("schema", "must be an existing time", created=created)


def test_a_run_on_another_spec_is_refused():
    unknown = "sha256:" + "1" * 64
    refused(
        "unknown_spec",
        f"runs.3.spec={unknown}: must be the digest of one of the suite's 3 instances "
        r"\(`sme show two-v1`\)",
        runs=[*RUNS, run(unknown)],
    )


def test_the_same_spec_and_seed_twice_is_refused():
    refused(
        "duplicate_run", "runs.3: seed=0: runs.1 has the same", runs=[*RUNS, run(A1, 0, policy(9))]
    )


def test_the_same_policy_twice_on_one_spec_is_refused():
    refused(
        "duplicate_run",
        "runs.3: policy=sha256.*1: runs.0 has the same",
        runs=[*RUNS, run(A0, 1, policy(1))],
    )


def test_one_policy_on_two_specs_and_several_failed_runs_on_one_pass():
    runs = [run(A0, 0, policy(1)), run(A1, 0, policy(1)), run(B0, 0), run(B0, 1)]
    accepted(runs=runs, runs_started={"A": 2, "B": 2})


def test_an_instance_without_a_run_is_refused():
    refused("missing_run", f"none on {A1} of class A", runs=[RUNS[0], RUNS[2]])


@pytest.mark.parametrize(
    ("started", "match"),
    [
        ({"A": 2, "B": 1, "C": 1}, "runs_started.C: must be a class of the suite: A, B"),
        ({"A": 2}, "runs_started.B=None: must be at least 1"),
        ({"A": 1, "B": 1}, "runs_started.A=1: must be at least 2"),
    ],
)
def test_runs_started_that_do_not_count_the_runs_listed_are_refused(started, match):
    refused("missing_run", match, runs_started=started)


def test_more_than_a_thousand_runs_started_are_refused():
    accepted(runs_started={"A": 900, "B": 100})
    refused(
        "schema",
        "runs_started=1001: must be at most 1,000 in total",
        runs_started={"A": 900, "B": 101},
    )


def test_runs_without_any_policy_are_refused_by_new_rules_only():
    runs = [run(A0), run(A1), run(B0)]
    refused("missing_run", "none has a policy", runs=runs)
    many = submission(runs=runs, runs_started={"A": 9_000, "B": 1_000})
    check_runs(BOARD.suite, many, rules=1)


def test_failed_runs_count_as_started():
    runs = [run(A0, 0, policy(1)), run(A1), run(B0), run(B0, 1)]
    refused("missing_run", "runs_started.B=1: must be at least 2", runs=runs)


def test_more_runs_started_than_listed_pass():
    accepted(runs_started={"A": 12, "B": 10})


def test_an_artefact_above_the_boards_limit_is_refused():
    accepted(runs=[*RUNS[:2], run(B0, 0, policy(3, size=1000))])
    refused(
        "too_large",
        "runs.2.artefact.size=1,001: must be at most 1,000 bytes",
        runs=[*RUNS[:2], run(B0, 0, policy(3, size=1001))],
    )


def board_of(instances, **fields):
    suite = Suite.from_dict(
        {"classes": [{"name": "A", "setting": SETTING, "seeds": list(range(instances))}]}
    )
    return BOARD.model_copy(update={"suite": suite, **fields})


def signed_runs(board, count, **changes):
    """The bytes of a submission with so many runs, all alike but for the seed."""
    runs = [
        {"spec": A0, "seed": number, "steps": 10**6, "artefact": policy(number, 10**6)}
        for number in range(count)
    ]
    made = submission(runs=runs, **changes)
    return SignedSubmission(submission=made, signature="0" * 128).to_bytes()


def test_the_most_runs_of_a_submission_fit_and_a_tenth_more_do_not():
    most = most_runs(BOARD)
    assert most == pytest.approx(200, abs=20)  # as docs/guides/leaderboard.md says
    assert len(signed_runs(BOARD, most)) <= MAX_BYTES < len(signed_runs(BOARD, most + most // 10))


def test_a_board_whose_suite_exceeds_a_submission_is_refused(tmp_path):
    most = most_runs(BOARD)
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
    ("unsafe_name", {"method__name": "<b>"}),
    ("unknown_suite", {"suite": {"name": "x", "digest": "sha256:" + "0" * 64}}),
    ("stale_time", {"created": "2020-01-01T00:00:00Z"}),
    ("unknown_spec", [run("sha256:" + "1" * 64)]),
    ("duplicate_run", [run(A0, 5), run(A0, 5)]),
    ("missing_run", {"runs_started": {"A": 100}}),
    ("too_large", [run(A0, 6, policy(8, size=1001))]),
]


@pytest.mark.parametrize("first", range(len(FAULTS)))
def test_the_first_of_several_faults_is_reported(first):
    changes, runs = {}, list(RUNS)
    for _, fault in FAULTS[first:]:
        if isinstance(fault, dict):
            changes.update(fault)
        else:
            runs += fault
    changes.setdefault("runs_started", {"A": 100, "B": 1})
    refused(FAULTS[first][0], ".", runs=runs, **changes)


def test_the_boards_own_submissions_are_checked_like_any_other():
    refused("unsafe_name", "method.name", submitter__key=BOARD.key, method__name="<b>")
    accepted(submitter__key=BOARD.key)
