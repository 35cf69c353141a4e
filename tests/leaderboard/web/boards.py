"""Boards with results drawn from a random stream: what the pages show, without any scoring."""

import numpy as np

from leaderboard.documents.result import Result
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.documents.submission import Submission
from leaderboard.scoring.ranking import levels_of, never_listed, result_of
from leaderboard.seasons.store import SeasonStore
from sme_registry.io import sha256_of
from sme_registry.spec import EvaluationProtocol
from tests.leaderboard.conftest import suite_of
from tests.leaderboard.store.synthetic import scored_run

CREATED = "2026-11-21T09:30:00Z"
HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>&amp;"
RTL = "evil\u202egnp.exe"
VERSIONS = {"sme-registry": "0.1.0", "onnxruntime": "1.24.1", "numpy": "2.4.6"}


def create(path, *, classes=3, references=True):
    """A board with its two reference rows."""
    plain = {"k": 1, "r_min": 0.0, "D": 0.0}
    numbers = range(1, classes + 1)
    suite = suite_of(**{f"plane{n}": (2, {**plain, "complexity": n}) for n in numbers})
    store = SeasonStore.create(
        path,
        title="Smoke board",
        suite_name="smoke-v1",
        suite=suite,
        protocol_name="paper-v1",
        protocol=EvaluationProtocol(),
        draws=200,
    )
    if references:
        submit_references(store)
    return store


def submit_references(store):
    key = store.folder.signing_key()
    fields = {"family": "reference", "submitter": "the board", "spread": 0.0}
    submit(store, key, "optimal", [0.0] * 6, knowledge="oracle", **fields)
    submit(store, key, "constant", [1.0] * 6, knowledge="family", **fields)


def submit(
    store, key, name, profile, *, version="1.0", family="PPO", knowledge="generic",
    submitter="Ada", runs=10, missing=0, spread=0.05, rejected=None, **fields
):  # fmt: skip
    """Submit a method and write the result that this profile, WD first, would give; its id.

    With a profile of None it waits; with `rejected`, a code and a message, it is rejected.
    """
    document = store.document
    specs = {}
    for digest, (member, _) in document.instances.items():
        specs.setdefault(member, []).append(digest)

    def run(member, number):
        policy = {"sha256": _digest(f"{name} {version} {member} {number}"), "size": 9}
        return {
            "spec": specs[member][number % len(specs[member])],
            "seed": number,
            "steps": 1_000_000 if family != "reference" else 0,
            "artefact": policy if profile is not None else None,
        }

    method = {"name": name, "version": version, "family": family, "knowledge": knowledge}
    plain = {
        "suite": document.suite_reference,
        "method": method,
        "submitter": {"name": submitter, "key": key.public},
        "created": CREATED,
        "runs": [run(member, number) for member in specs for number in range(runs)],
        "runs_started": dict.fromkeys(specs, runs + missing),
        **fields,
    }
    signed = Submission.from_dict(plain).signed(key, Receiver(document.key))
    store.receive(signed)
    if profile is not None:
        assert score(store, profile, spread) == signed.id
    elif rejected is not None:
        code, message = rejected
        finish(store, claimed(store), status="rejected", code=code, message=message)
    return signed.id


def claimed(store):
    return store.queue.claim("synthetic")


def finish(store, claim, **result):
    """Write the result of a claimed submission."""
    suite, protocol = store.document.suite.digest, store.document.protocol.digest
    digests = {"submission": claim.id, "suite": suite, "protocol": protocol}
    assert store.queue.finish(claim, Result(**digests, **result))


def score(store, profile, spread=0.0):
    """Write a result of about this profile for the submission whose turn it is; its id."""
    document, claim = store.document, claimed(store)
    submission = store.submission(claim.id).content
    levels, instances = levels_of(document.protocol), document.instances
    # Not from the id, which holds a key that is new each time.
    name = f"{submission.method.name} {submission.method.version}"
    rng = np.random.default_rng(int(_digest(name)[7:23], 16))
    runs = []
    for number, run in enumerate(submission.runs):
        regret = np.abs(np.asarray(profile) + spread * rng.normal(size=len(levels)))
        of_run = instances[run.spec][0], run.spec, run.artefact.sha256, regret.tolist()
        runs.append(scored_run(document.protocol, *of_run, seed=2**52 + 7919 * number))
    unlisted = never_listed(document, submission)
    result = result_of(document, claim.id, runs, VERSIONS, unlisted=unlisted)
    assert store.queue.finish(claim, result)
    return claim.id


def _digest(text):
    return sha256_of(text.encode())


def furnish(store):
    """Every kind of entry; their ids by what they are."""
    lab, okafor, anon, student = (SigningKey.generate() for _ in range(4))
    delft = {"version": "2.7.1", "submitter": "Control Lab, Delft"}
    of_okafor = {"submitter": "R. Okafor"}

    def add(key, name, start, step, **fields):
        return submit(store, key, name, [start + step * m for m in range(6)], **fields)

    training = {
        "library": "Stable-Baselines3 2.7.1",
        "hyperparameters": "learning_rate=3e-4\nbatch_size=256\nnet_arch=[256, 256]",
        "hardware": "1 × RTX 4090, 3 h",
    }
    statement = "Trained with the library's defaults.\nNo tuning on the evaluation states."
    code = "https://example.org/sac?a=1&b=2"
    described = {"code": code, "training": training, "statement": statement}
    hostile = {
        "version": HOSTILE[:80],
        "family": "a\"onx='",
        "submitter": (RTL + HOSTILE)[:80],
        "statement": HOSTILE * 3,
        "code": 'https://example.org/"onmouseover="alert(1)\'<script>',
        "training": {"library": HOSTILE, "hyperparameters": HOSTILE, "hardware": "</dd></dl>"},
    }
    long = {
        "version": "2026.11-beta+4",
        "family": "ensemble",
        "submitter": "Group for Monitoring and Control of Synthetic Environments",
    }
    long_name = "A method with quite a long name (ensemble of 16 critics)"
    own = {"version": "0.3", "family": "model-based", "knowledge": "family", "submitter": "Anon"}
    broken = "onnx_op", "node 3: op_type='Loop<script>': must be one of the list."
    return {
        "sac": add(lab, "SAC", 0.08, 0.06, **delft, family="SAC", **described),
        "td3": add(lab, "TD3", 0.10, 0.07, **delft, family="TD3", spread=0.03),
        "ppo": add(okafor, "PPO", 0.24, 0.09, version="2.7.1", missing=1, spread=0.08, **of_okafor),
        "model": add(anon, "DUN-fit", 0.004, 0.0002, **own, spread=0.001),
        "long": add(anon, long_name, 0.62, 0.11, **long, spread=0.06),
        "few": add(student, "PPO small", 0.3, 0.05, runs=2, submitter="Student"),
        "hostile": add(student, "x<b>y", 0.5, 0.02, **hostile),
        "rejected": submit(
            store, okafor, "Broken", None, version="0.1", rejected=broken, **of_okafor
        ),
        "waiting": submit(store, okafor, "PPO", None, version="2.7.2", **of_okafor),
    }
