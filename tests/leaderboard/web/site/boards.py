"""Boards with results drawn from a random stream: what the pages show, without any scoring."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.result import ClassScore, Estimate, Result, RunScore, Scores
from leaderboard.documents.submission import Artefact, Method, Run, Submission, Submitter, Training
from leaderboard.store import Store
from sme_registry.io import sha256_of
from sme_registry.spec import EvaluationProtocol, Suite

CREATED = "2026-11-21T09:30:00Z"
HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>&amp;"
RTL = "evil\u202egnp.exe"


def suite(classes: int = 3, instances: int = 2) -> Suite:
    setting = {"state_dim": 2, "action_dim": 1, "k": 1, "r_min": 0.0, "D": 0.0, "complexity": 1}
    return Suite.from_dict(
        {
            "classes": [
                {
                    "name": f"plane{index + 1}",
                    "setting": {**setting, "complexity": index + 1},
                    "seeds": list(range(1, instances + 1)),
                }
                for index in range(classes)
            ]
        }
    )


def create(path: Path, *, classes: int = 3, title: str = "Smoke board", **fields: object) -> Store:
    """A board with its two reference rows."""
    store = Store.create(
        path,
        title=title,
        suite_name="smoke-v1",
        suite=suite(classes),
        protocol_name="paper-v1",
        protocol=EvaluationProtocol(),
        **fields,
    )
    key = store.folder.signing_key()
    for name, level in (("optimal", 0.0), ("constant", 1.0)):
        knowledge = "oracle" if name == "optimal" else "family"
        submit(
            store,
            key,
            name,
            [level] * 6,
            family="reference",
            knowledge=knowledge,
            spread=0.0,
            submitter="the board",
        )
    return store


def submit(
    store: Store,
    key: SigningKey,
    name: str,
    profile: Sequence[float] | None,
    *,
    version: str = "1.0",
    family: str = "PPO",
    knowledge: str = "generic",
    submitter: str = "Ada",
    runs: int = 10,
    missing: int = 0,
    spread: float = 0.05,
    code: str | None = None,
    statement: str = "",
    training: Training | None = None,
    rejected: tuple[str, str] | None = None,
    oracle_like: bool = False,
) -> str:
    """Submit a method and write the result that this profile, WD first, would give; its id.

    With a profile of None it waits; with `rejected`, a code and a message, it is rejected.
    """
    document = store.document
    instances = document.instances
    by_class: dict[str, list[str]] = {}
    for digest, (member, _) in instances.items():
        by_class.setdefault(member, []).append(digest)
    submission = Submission(
        suite=document.suite_reference,
        method=Method.from_dict(
            {"name": name, "version": version, "family": family, "knowledge": knowledge}
        ),
        code=code,
        submitter=Submitter(name=submitter, key=key.public),
        created=CREATED,
        runs=tuple(
            Run(
                spec=specs[index % len(specs)],
                seed=index,
                steps=1_000_000 if family != "reference" else 0,
                artefact=Artefact(sha256=_digest(f"{name} {version} {member} {index}"), size=9)
                if profile is not None
                else None,
            )
            for member, specs in by_class.items()
            for index in range(runs)
        ),
        runs_started=dict.fromkeys(by_class, runs + missing),
        training=training or Training(),
        statement=statement,
    )
    signed = submission.signed(key, document.key)
    store.receive(signed)
    if profile is None and rejected is None:
        return signed.id
    claim = store.queue.claim("synthetic")
    assert claim is not None
    assert claim.id == signed.id
    common = {
        "submission": signed.id,
        "suite": document.suite.digest,
        "protocol": document.protocol.digest,
    }
    if rejected is not None:
        result = Result(**common, status="rejected", code=rejected[0], message=rejected[1])
    else:
        assert profile is not None
        result = _result(document, submission, profile, spread, missing, common, oracle_like)
    assert store.queue.finish(claim, result)
    return signed.id


def _digest(text: str) -> str:
    return sha256_of(text.encode())


def _result(
    document: BoardDocument,
    submission: Submission,
    profile: Sequence[float],
    spread: float,
    missing: int,
    common: dict[str, str],
    oracle_like: bool,
) -> Result:
    # Not from the id, which holds a key that is new each time.
    name = f"{submission.method.name} {submission.method.version}"
    rng = np.random.default_rng(int(_digest(name)[7:23], 16))
    epsilons = np.array([0.0, *document.protocol.epsilons])
    instances = document.instances
    scores: list[RunScore] = []
    for index, run in enumerate(submission.runs):
        member, _ = instances[run.spec]
        regret = np.abs(np.asarray(profile) + spread * rng.normal(size=len(epsilons)))
        scores.append(_run(member, run, regret, epsilons, index))
    for member in submission.runs_started:
        scores += [_run(member, None, np.ones(len(epsilons)), epsilons, 0) for _ in range(missing)]
    regrets = np.array([score.normalised_regret for score in scores])
    half = spread * np.array([1.0, 0.6, 1.4])
    classes = []
    for member in submission.runs_started:
        own = [score for score in scores if score.class_name == member]
        mean = np.mean([score.normalised_regret for score in own], axis=0)
        classes.append(
            ClassScore(
                name=member,
                runs=len(own),
                submitted=sum(score.artefact is not None for score in own),
                wd_regret=float(mean[0]),
                ood_regret=float(mean[1:].mean()),
                normalised_regret=tuple(mean.tolist()),
            )
        )
    mean = regrets.mean(axis=0)
    return Result(
        **common,
        status="scored",
        scores=Scores(
            wd_regret=_estimate(mean[0], half[0], 0.0),
            ood_regret=_estimate(mean[1:].mean(), half[0], 0.0),
            ood_decay=_estimate(mean[1:].mean() - mean[0], half[1]),
            regret_slope=_estimate(np.polyfit(epsilons, mean, 1)[0], half[1]),
            similarity_loss=_estimate(25 * (mean[1:].mean() - mean[0]), 10 * half[1]),
            normalised_regret=tuple(_estimate(value, half[2], 0.0) for value in mean),
        ),
        classes=tuple(classes),
        runs=tuple(scores),
        enough_runs=all(member.runs >= document.runs_to_rank for member in classes),
        oracle_like=oracle_like,
        versions={"sme-registry": "0.1.0", "onnxruntime": "1.24.1", "numpy": "2.4.6"},
    )


def _run(
    member: str, run: Run | None, regret: np.ndarray, epsilons: np.ndarray, index: int
) -> RunScore:
    policy = run is not None and run.artefact is not None
    wd, ood = float(regret[0]), float(regret[1:].mean())
    return RunScore(
        spec=run.spec if run is not None else None,
        class_name=member,
        artefact=run.artefact.sha256 if run is not None and run.artefact else None,
        evaluation_seed=2**52 + 7919 * index if policy else None,
        normalised_regret=tuple(regret.tolist()),
        similarity=tuple((1 - 0.25 * regret).tolist()) if policy else None,
        wd_regret=wd,
        ood_regret=ood,
        ood_decay=ood - wd,
        regret_slope=float(np.polyfit(epsilons, regret, 1)[0]),
        similarity_loss=25 * (ood - wd) if policy else 0.0,
    )


def _estimate(value: float, half: float, least: float = -np.inf) -> Estimate:
    return Estimate(
        value=float(value), low=max(least, float(value - half)), high=float(value + 1.2 * half)
    )


def furnish(store: Store) -> dict[str, str]:
    """Every kind of entry; their ids by what they are."""
    keys = [SigningKey.generate() for _ in range(4)]

    def rising(start: float, step: float) -> list[float]:
        return [start + step * m for m in range(6)]

    ids = {}
    ids["sac"] = submit(
        store,
        keys[0],
        "SAC",
        rising(0.08, 0.06),
        version="2.7.1",
        family="SAC",
        submitter="Control Lab, Delft",
        code="https://example.org/sac?a=1&b=2",
        training=Training(
            library="Stable-Baselines3 2.7.1",
            hyperparameters="learning_rate=3e-4\nbatch_size=256\nnet_arch=[256, 256]",
            hardware="1 × RTX 4090, 3 h",
        ),
        statement="Trained with the library's defaults.\nNo tuning on the evaluation states.",
    )
    ids["td3"] = submit(
        store,
        keys[0],
        "TD3",
        rising(0.10, 0.07),
        version="2.7.1",
        family="TD3",
        submitter="Control Lab, Delft",
        spread=0.03,
    )
    ids["ppo"] = submit(
        store,
        keys[1],
        "PPO",
        rising(0.24, 0.09),
        version="2.7.1",
        submitter="R. Okafor",
        missing=1,
        spread=0.08,
    )
    ids["model"] = submit(
        store,
        keys[2],
        "DUN-fit",
        rising(0.004, 0.0002),
        version="0.3",
        family="model-based",
        knowledge="family",
        submitter="Anon",
        spread=0.001,
        oracle_like=True,
    )
    ids["long"] = submit(
        store,
        keys[2],
        "A method with quite a long name (ensemble of 16 critics)",
        [0.62, 0.71, 0.85, 0.93, 1.08, 1.17],
        version="2026.11-beta+4",
        family="ensemble",
        submitter="Group for Monitoring and Control of Synthetic Environments",
        spread=0.06,
    )
    ids["few"] = submit(
        store,
        keys[3],
        "PPO small",
        rising(0.3, 0.05),
        runs=2,
        submitter="Student",
    )
    ids["hostile"] = submit(
        store,
        keys[3],
        "x<b>y",
        rising(0.5, 0.02),
        version=HOSTILE[:80],
        family="a\"onx='",
        submitter=(RTL + HOSTILE)[:80],
        statement=HOSTILE * 3,
        code='https://example.org/"onmouseover="alert(1)\'<script>',
        training=Training(library=HOSTILE, hyperparameters=HOSTILE, hardware="</dd></dl>"),
    )
    ids["rejected"] = submit(
        store,
        keys[1],
        "Broken",
        None,
        version="0.1",
        submitter="R. Okafor",
        rejected=(
            "onnx_op",
            "node 3: op_type='Loop<script>': must be one of the list in the documentation. "
            "Export the policy alone.",
        ),
    )
    ids["waiting"] = submit(store, keys[1], "PPO", None, version="2.7.2", submitter="R. Okafor")
    return ids
