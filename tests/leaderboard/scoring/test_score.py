"""`score_submission`: numbers, flags and rejections of real policies in the sandbox."""

import hashlib
import os
import signal
import sys
import types
from importlib import metadata

import numpy as np
import pytest
from onnx import numpy_helper

from leaderboard.documents.result import METRICS
from leaderboard.documents.signed import SigningKey
from leaderboard.documents.submission import Submission
from leaderboard.errors import BoardError
from leaderboard.gate.isolation import available_isolation
from leaderboard.gate.networks import constant_onnx, optimal_onnx
from leaderboard.scoring import score as score_module
from leaderboard.scoring.score import evaluation_seed, score_submission
from sme_registry import EvaluationProtocol, evaluate
from sme_registry.io import sha256_of
from sme_registry.spec import Suite
from tests.leaderboard.conftest import document_of, plain_submission, suite_of
from tests.leaderboard.gate import models
from tests.leaderboard.gate.test_sandbox import children

KEY = SigningKey.generate()
SMALL = {"action_dim": 2}
SUITE = suite_of(shallow=(2, SMALL), deep=(1, {**SMALL, "complexity": 3}))
BOARD = document_of(SUITE, key=KEY.public, rules=2, runs_to_rank=2, draws=200)
ONE = BOARD.model_copy(update={"suite": Suite.from_dict({"classes": [SUITE.classes[1].to_dict()]})})
"""The deep instance alone."""


def as_bytes(model):
    return model.SerializeToString(deterministic=True)


def score(*policies, progress=None, opened=None, board=BOARD, runs_started=None):
    """Score these policies on the suite's instances in order, again from the first one on."""
    instances = board.suite.instances
    data = {}
    runs = []
    for index, policy in enumerate(policies):
        spec = instances[index % len(instances)]
        content = policy(spec) if callable(policy) else policy
        artefact = None
        if content is not None:
            data[sha256_of(content)] = content
            artefact = {"sha256": sha256_of(content), "size": len(content)}
        runs.append({"spec": spec.digest, "seed": index, "steps": 10, "artefact": artefact})
    plain = plain_submission(board, runs, KEY.public)
    plain["runs_started"] |= runs_started or {}
    submission = Submission.from_dict(plain)

    def artefact_of(digest):
        if opened is not None:
            opened.append(digest)
        return data[digest]

    return score_submission(board, submission, artefact_of, progress)


LINEAR = as_bytes(models.linear())


@pytest.fixture(scope="module")
def scored():
    """A submission with a failed run and three that are not listed, and what `progress` heard."""
    calls = []
    result = score(
        *(LINEAR, None, LINEAR),
        runs_started={"shallow": 4, "deep": 1},
        progress=lambda done, total: calls.append((done, total)),
    )
    return result, calls


def test_the_seed_is_the_first_53_bits_of_the_three_digests():
    bits = bin(int(hashlib.sha256(b"p\ns\na").hexdigest(), 16))[2:].zfill(256)
    assert evaluation_seed("p", "s", "a") == int(bits[:53], 2)
    assert len({evaluation_seed(*digests) for digests in ("psa", "qsa", "pta", "psb")}) == 4


def test_a_copy_of_the_optimal_policy_scores_zero_and_is_flagged_and_the_constant_one_scores_one():
    # What an open board cannot tell: the specs are public, and so is π*. It shows performance,
    # never learning; all that the board can do is to ask for code.
    result = score(optimal_onnx, board=ONE)
    assert all(0.0 <= N < 1e-6 for N in result.runs[0].normalised_regret)
    assert result.oracle_like
    constant = score(constant_onnx, board=ONE)
    assert set(constant.runs[0].normalised_regret) == {1.0}
    assert constant.scores.ood_decay.value == constant.scores.regret_slope.value == 0.0
    assert not constant.oracle_like


def test_a_run_has_the_numbers_that_anyone_can_recompute(scored):
    W = numpy_helper.to_array(models.linear().graph.initializer[0])
    for index in (0, 2):
        run, spec = scored[0].runs[index], SUITE.instances[index]
        seed = evaluation_seed(BOARD.protocol.digest, spec.digest, sha256_of(LINEAR))
        report = evaluate(
            lambda observations: observations @ W,
            spec,
            EvaluationProtocol(states_per_region=60, seed=seed),
        )
        regret = [region.normalised_regret for region in report.regions]
        similarity = [region.similarity for region in report.regions]
        assert run.evaluation_seed == seed
        assert run.normalised_regret == pytest.approx(regret, abs=1e-6)
        assert run.similarity == pytest.approx(similarity, abs=1e-6)
        assert run.ood_regret == pytest.approx(np.mean(regret[1:]), abs=1e-6)
        assert run.similarity_loss == pytest.approx(
            100 * (similarity[0] - np.mean(similarity[1:])), abs=1e-4
        )
        assert run.actions  # by which copies are found


def test_a_result_is_the_same_each_time_whatever_else_is_loaded(monkeypatch):
    first = score(LINEAR, board=ONE)
    monkeypatch.setitem(sys.modules, "torch", types.ModuleType("torch"))
    again = score(LINEAR, board=ONE)

    assert first == again
    assert {"sme_registry", "python", "numpy", "onnxruntime"} <= set(first.versions)
    assert first.versions["onnxruntime"] == metadata.version("onnxruntime")


def test_failed_and_unlisted_runs_score_one(scored):
    result = scored[0]
    shallow, deep = result.classes
    assert (shallow.runs, shallow.submitted) == (4, 1)
    assert (deep.runs, deep.submitted) == (1, 1)
    assert [run.artefact is None for run in result.runs] == [False, True, False]
    failed = result.runs[1]
    assert failed.normalised_regret == (1.0,) * 6
    assert failed.similarity is failed.evaluation_seed is None
    assert failed.actions is None
    assert [getattr(failed, name) for name in METRICS] == [1.0, 1.0, 1.0, 1.0, 100.0]
    # The unlisted runs are one on each instance: [N, 1] and [1, 1].
    assert shallow.wd_regret == pytest.approx((result.runs[0].wd_regret + 3.0) / 4.0)
    # The states of every policy are counted.
    assert scored[1] == [(60 * region, 60 * 12) for region in range(1, 13)]


def test_what_its_documents_show_rejects_a_submission_before_scoring():
    opened = []
    for result, code, fact in [
        (score(*[LINEAR] * 6, opened=opened), "duplicate_run", "runs.3"),
        (
            score(LINEAR, LINEAR, LINEAR, opened=opened, runs_started={"deep": 10**12}),
            *("schema", "runs_started=1000000000002: must be at most 1,000"),
        ),
    ]:
        assert (result.status, result.code) == ("rejected", code)
        assert fact in result.message
        assert result.isolation == available_isolation()
        assert {"sme_registry", "python", "numpy"} <= set(result.versions)
    assert opened == []


LARGE = models.tensor("large", np.float32(1e6))
AMPLIFYING = models.squashed(
    [models.node("Mul", "y large", "m"), models.node("Sin", "m", "a")], [LARGE]
)
DEPENDENT_OUTSIDE = models.squashed(
    [
        models.node("Sub", "o far", "d"),
        models.node("Relu", "d", "r"),  # 0 for every state within ε = 0.6
        models.node("ReduceMean", "r", "m", keepdims=1),  # over the batch
        models.node("Add", "y m", "a"),
    ],
    [models.tensor("far", np.float32(1.3))],
)


@pytest.mark.parametrize(
    ("policy", "code"),
    [
        (b"not a model", "onnx_malformed"),
        (as_bytes(models.squashed([models.node("Log", "y", "a")])), "run_not_finite"),
        (as_bytes(models.model([models.node("Abs", "o", "a")])), "run_output"),
        (as_bytes(AMPLIFYING), "run_rounding"),
        (as_bytes(DEPENDENT_OUTSIDE), "run_batch_dependent"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_rejected_artefact_rejects_the_submission_and_is_named(policy, code):
    result = score(None, policy, LINEAR)
    assert (result.status, result.code) == ("rejected", code)
    assert result.message.startswith(
        f"runs.1 (class shallow, spec {SUITE.instances[1].digest}, policy {sha256_of(policy)}): "
    )
    assert result.scores is None
    assert result.runs == ()


class Recorder:
    """What a `_CheckedPolicy` checks of a sandbox: region and first state of each batch."""

    def __init__(self):
        self.checked = []

    def __call__(self, observations):
        return observations[:, :1]

    def check_rows(self, observations, rows):
        self.checked.append((int(observations[0, 0]), int(observations[0, 1])))

    def check_last_place(self, observations):
        pass


def checks(regions, batches):
    recorder = Recorder()
    policy = score_module._CheckedPolicy(recorder, sum(batches), 1)
    for region in range(regions):
        first = 0
        for rows in batches:
            numbers = np.arange(first, first + rows)
            policy(np.stack(np.broadcast_arrays(region, numbers), axis=1))
            first += rows
    return recorder.checked


def test_a_random_batch_and_the_last_of_each_region_are_checked():
    chosen = checks(40, [800, 800, 800, 100])
    assert {region for region, first in chosen if first == 2400} == set(range(40))
    others = [first for _, first in chosen if first != 2400]
    assert set(others) == {0, 800, 1600}
    assert 30 <= len(others) <= 40
    assert chosen != checks(40, [800, 800, 800, 100])


def test_one_policy_in_two_files_is_refused_and_both_runs_are_named():
    zero, one = (models.tensor("number", np.float32(number)) for number in (0.0, 1.0))
    original = as_bytes(models.squashed([models.node("Add", "y number", "a")], [zero]))
    copy = as_bytes(models.squashed([models.node("Mul", "y number", "a")], [one]))
    result = score(original, None, None, copy)
    assert (result.status, result.code) == ("rejected", "run_repeated")
    assert result.message.startswith("runs.3 (class shallow")
    assert "runs.0 in the same states" in result.message


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_errors_of_the_scorer_do_not_reject_the_submission(error):
    def stop(done, total):
        raise error

    with pytest.raises(error):
        score(LINEAR, board=ONE, progress=stop)


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="finds its children in /proc")
def test_a_sandbox_ended_from_outside_does_not_reject_the_submission():
    before = children()

    def end_it(done, total):
        for child in children() - before:
            os.kill(child, signal.SIGKILL)

    with pytest.raises(BoardError, match="not caused by the model"):
        score(LINEAR, board=ONE, progress=end_it)
