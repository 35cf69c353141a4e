"""A board so small that scoring takes a moment, and policies that are real ONNX files."""

import functools
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from leaderboard.cli.submit import KEY_VARIABLE
from leaderboard.documents.board import BoardDocument, hex_of
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Submission, Withdrawal, now
from leaderboard.seasons.store import SeasonStore
from sme_registry import EvaluationProtocol
from sme_registry.io import sha256_of
from sme_registry.spec import Suite
from tests.leaderboard.clocks import move_clock

Submit = Callable[..., Signed[Submission]]
ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "board"
SEASONS = ROOT / "docs" / "results" / "season" / "board"
"""Of rules 2, with two revealed seasons."""


def suite_of(**classes):
    """Classes by name: their number of instances, and what differs from S = 2 and A = 1."""
    members = [
        {
            "name": name,
            "setting": {"state_dim": 2, "action_dim": 1, **setting},
            "seeds": list(range(instances)),
        }
        for name, (instances, setting) in classes.items()
    ]
    return Suite.from_dict({"classes": members})


def tiny_suite(instances=1):
    """One class of the smallest tasks."""
    return suite_of(Tiny=(instances, {}))


def document_of(suite, **fields):
    """A board's document, without its folder."""
    plain = {"title": "Small", "suite_name": "small-v1", "protocol_name": "few-v1", "rules": 3}
    protocol = EvaluationProtocol(states_per_region=60)
    fields = {"suite": suite, "protocol": protocol, "key": "0" * 64, **fields}
    return BoardDocument(**plain | fields)


def plain_submission(document, runs, key="0" * 64, **fields):
    """The fields of a submission with these runs, and no others started."""
    instances = document.instances
    names = Counter(instances[run["spec"]][0] for run in runs if run["spec"] in instances)
    return {
        "suite": document.suite_reference,
        "method": {"name": "PPO", "version": "1.0", "family": "PPO", "knowledge": "generic"},
        "submitter": {"name": "A Lab", "key": key},
        "created": "2026-11-21T12:00:00Z",
        "runs": runs,
        "runs_started": dict(names),
        **fields,
    }


def tiny_board(path, *, instances=1, **fields):
    """A new board of 200 states in each region; the caller closes it."""
    settings = {"runs_to_rank": 1, "draws": 100, **fields}
    return SeasonStore.create(
        path,
        title="Tiny",
        suite_name="tiny-v1",
        suite=tiny_suite(instances),
        protocol_name="quick-v1",
        protocol=EvaluationProtocol(states_per_region=200),
        **settings,
    )


@functools.cache
def linear_onnx(number, observation_dim=4, action_dim=1):
    """A policy a = clip(s W + number/1000, 0, 1), one of its own for each number."""
    from tests.leaderboard.gate.models import model, node, tensor, value  # which import onnx

    constants = {
        "W": np.full((observation_dim, action_dim), 0.1),
        "b": np.full(action_dim, number / 1000),
        "low": 0.0,
        "high": 1.0,
    }
    return model(
        [node("Gemm", "o W b", "raw"), node("Clip", "raw low high", "a")],
        [tensor(name, np.asarray(each, np.float32)) for name, each in constants.items()],
        inputs=[value("o", "batch", observation_dim)],
        outputs=[value("a", "batch", action_dim)],
    ).SerializeToString()


def tiny_submission(store, key, number=0, **fields):
    """A signed submission, valid on a tiny board, and its artefacts by their digests.

    Another number is another policy.
    """
    data = linear_onnx(number)
    policy = {"sha256": sha256_of(data), "size": len(data)}
    runs = [
        {"spec": spec.digest, "seed": number, "steps": 1000, "artefact": policy}
        for spec in store.document.suite.instances
    ]
    method = {"name": f"Linear {number}", "version": "1", "family": "linear"}
    own = {
        "method": {**method, "knowledge": "generic"},
        "submitter": {"name": f"Tester {key.public[:8]}", "key": key.public},
        "created": now(),
    }
    plain = plain_submission(store.document, fields.pop("runs", runs), **own | fields)
    return Submission.from_dict(plain).signed(key, Receiver(store.document.key)), {
        policy["sha256"]: data
    }


def write_bundle(folder, signed, artefacts):
    """A bundle's folder."""
    (folder / "artefacts").mkdir(parents=True)
    (folder / "submission.json").write_bytes(signed.to_bytes())
    for digest, data in artefacts.items():
        (folder / "artefacts" / f"{hex_of(digest)}.onnx").write_bytes(data)
    return folder


def put_submission(store, key, number=0, **fields):
    """`tiny_submission`, with its artefacts on the board and waiting to be scored."""
    signed, artefacts = tiny_submission(store, key, number, **fields)
    for digest, data in artefacts.items():
        store.put_object(digest, data, by=key.public)
    assert store.receive(signed)
    return signed


def put_policy(store, key, data, number=0):
    """`put_submission`, with one run: this artefact on the suite's first instance."""
    digest = sha256_of(data)
    store.put_object(digest, data, by=key.public)
    run = {
        "spec": store.document.suite.instances[0].digest,
        "seed": 0,
        "steps": 5,
        "artefact": {"sha256": digest, "size": len(data)},
    }
    return put_submission(store, key, number, runs=[run])


def signed_withdrawal(store, id, key, reason="a test", address=None):
    """A withdrawal of a submission of a board, signed by this key."""
    withdrawal = Withdrawal(submission=id, created=now(), reason=reason)
    return withdrawal.signed(key, Receiver(store.document.key, address))


def document_path(board, id, kind="document"):
    """The file of a submission's document, `result` or `withdrawal` on a board of this folder."""
    with SeasonStore.open(board, read_only=True) as store, store.reading() as index:
        (digest,) = index.one(f"SELECT {kind} FROM entry WHERE id = ?", id)
        return store.folder.object(digest)


def derived(store):
    """The rows of the index that follow from the log, by their table."""
    with store.reading() as index:
        tables = index.connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        names = sorted({name for (name,) in tables} - {"lease", "upload", "clock"})
        return {
            name: sorted(index.connection.execute(f"SELECT * FROM {name}"), key=str)
            for name in names
        }


@pytest.fixture
def key():
    return SigningKey.generate()


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The folder in which commands run, with the file of the user's key; wide lines."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv(KEY_VARIABLE, str(tmp_path / "my.key"))
    return tmp_path


@pytest.fixture
def store(tmp_path):
    with tiny_board(tmp_path / "board") as made:
        yield made


@pytest.fixture
def later(monkeypatch):
    """Moves the clock behind the close of tiny seasons."""
    return functools.partial(move_clock, monkeypatch)


@pytest.fixture
def submit(store, key):
    """Puts the tiny submission of a number on the board of `store`, signed by `key`."""
    return functools.partial(put_submission, store, key)
