"""`score_submission`: from a submission and its policy files to a `Result`.

    run → sandbox → evaluate on the run's own states → N_m → metrics → `aggregation` → θ

Protocol, spec and policy file determine the seed of a run's states:

    seed = first 53 bits of SHA-256(protocol digest, spec digest, file's digest)

Anyone can recompute it, and each attempt at luckier states needs another policy. The checks of a
policy's behaviour use states and batches that the system's randomness draws, so no policy can
behave well only where it is checked. Memory holds one file and one batch of states at a time.

Bytes prove nothing: permuted units or a little noise give another file. Policies are therefore
compared by their actions a in states of which half are in the training cube, half outside it, up
to the outermost face of the protocol. Within a submission the seed of these states,

    SHA-256(protocol digest, spec digest, submission id)

is unknown until all its policies are fixed, so none can be altered in them alone. In the same
states of one instance, inside or outside:

    d(i, j)  = mean |a_i − a_j|                             distance of two runs
    u(i)     = min(mean |a_i − a*|, mean |a_i − E a_i|)     its error, or its variation if smaller
    repeated if d ≤ max(FRACTION min(u(i), u(j)), FLOOR)

Policies that hardly vary are exempt: agents often collapse to one constant, which scores 1 or
worse, and repeating it gains nothing. Between submissions, policies are copies if their actions in
the board's states, which all submissions share, are exactly equal.

The smallest d / min(u, u') of three runs, on Default (S = 8, π* of one layer) and Plane10 (S = 2,
ten layers): PPO, TD3 and SAC of 2,048 to 102,400 steps 0.090, a network after 100 updates to fit π*
0.076, a linear map fitted to 10,000 states 0.010; a copy with 1 % noise in its weights 0.020 to
0.057, with 5 % 0.10 to 0.27.

`B` states of a half, `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

import hashlib
import secrets
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import Result, RunScore
from leaderboard.documents.submission import Submission
from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation, available_isolation
from leaderboard.gate.sandbox import Actions, Observations, Sandbox, SandboxLimits, widths
from leaderboard.scoring.ranking import failed_run, never_listed, result_of, scored_run
from sme_registry import SMESpec, evaluate, materialize
from sme_registry.errors import PolicyError, SMEError
from sme_registry.evaluation import EvaluationReport, as_policy
from sme_registry.io import versions
from sme_registry.spec import EvaluationProtocol
from sme_registry.task.engine import engine

Progress = Callable[[int, int], None]

FRACTION, FLOOR = 0.03, 1e-5
CONSTANT = 1e-3
"""Policies whose actions vary by less, mean |a − E a| over the states, are not compared."""

STATES = 256
"""States inside the cube, and as many outside."""

COMPARED = 4 * STATES
"""States in which a run is observed: its submission's, and the board's."""

_Array = npt.NDArray[np.float64]
_WHERE = ("inside", "outside")

_SINGLE_ROWS = 8  # of a checked batch, evaluated one at a time
# May be loaded in the same process, but no number of a result depends on them.
_UNUSED = ("stable_baselines3", "torch")


def evaluation_seed(protocol_digest: str, spec_digest: str, file_digest: str) -> int:
    """The seed of a run's states, in [0, 2⁵³)."""
    text = f"{protocol_digest}\n{spec_digest}\n{file_digest}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 11


def score_submission(
    board: BoardDocument,
    submission: Submission,
    policy_file: Callable[[str], bytes],
    progress: Progress | None = None,
    *,
    isolation: Isolation | None = None,
) -> Result:
    """Score every run of an admitted submission, and the method over its runs.

    The result is a function of board, submission and files up to floating-point rounding, but for
    `RunScore.actions`, and a rejection if a policy file, or its behaviour, is rejected. A
    `ScoringFault`, of the sandbox or of the machine, judges nothing.
    """
    scoring = _Scoring(board, submission, policy_file, progress, isolation)
    try:
        unlisted = never_listed(board, submission)
        runs = list(map(scoring.run, range(len(submission.runs))))
    except Rejection as error:
        return Result(
            submission=submission.digest,
            suite=board.suite.digest,
            protocol=board.protocol.digest,
            status="rejected",
            code=error.code,
            message=error.message,
            versions=scoring.versions,
            isolation=scoring.isolation,
        )
    return result_of(
        *(board, submission.digest, runs, scoring.versions),
        unlisted=unlisted,
        isolation=scoring.isolation,
    )


class _Scoring:
    """The scoring of one submission. What scores is recorded, whatever becomes of it."""

    def __init__(
        self,
        board: BoardDocument,
        submission: Submission,
        policy_file: Callable[[str], bytes],
        progress: Progress | None,
        isolation: Isolation | None,
    ) -> None:
        self.isolation: Isolation = isolation or available_isolation()
        self.versions = versions(["numpy", "onnx"])
        self._board, self._runs, self._instances = board, submission.runs, board.instances
        self._policy_file, self._progress = policy_file, progress
        self._behaviours = Behaviours(board.protocol, submission.digest)
        self._evaluated = 0  # policies

    def run(self, index: int) -> RunScore:
        """The score of a listed run; in order."""
        board, run = self._board, self._runs[index]
        class_name, spec = self._instances[run.spec]
        if run.artefact is None:
            return failed_run(board.protocol, class_name, run.spec)
        digest = run.artefact.sha256
        try:
            report, actions = self._evaluate(f"runs.{index}", spec, digest)
        except Rejection as error:
            raise Rejection(
                error.code,
                f"runs.{index} (class {class_name}, spec {run.spec}, policy {digest}): "
                f"{error.message}",
            ) from None
        self._evaluated += 1
        return scored_run(
            *(report, class_name, digest, board.rules),
            spec=run.spec,
            evaluation_seed=report.protocol.seed,
            actions=actions,
        )

    def _evaluate(
        self, name: str, spec: SMESpec, digest: str
    ) -> tuple[EvaluationReport, str | None]:
        """Evaluate a policy in the sandbox on the states of its own seed; digest its actions."""
        data, protocol = self._policy_file(digest), self._board.protocol
        agents, states = max(1, len(agent_names(spec))), protocol.states_per_region
        rows = states * len(protocol.edges) + COMPARED
        limits = SandboxLimits.for_policy(len(data), rows, agents)
        with Sandbox(data, *widths(spec), limits, isolation=self.isolation) as sandbox:
            self.versions["onnxruntime"] = sandbox.runtime
            policy = _CheckedPolicy(sandbox, states, agents)
            seed = evaluation_seed(protocol.digest, spec.digest, digest)
            own = protocol.model_copy(update={"seed": seed})
            try:
                report = evaluate(
                    policy, spec, own, action_range="unit", name=digest, progress=self._advanced
                )
                actions = self._behaviours.observe(name, spec, sandbox)
            except PolicyError as error:  # as policies wrap the errors of any callable
                raise error.__cause__ if isinstance(error.__cause__, SMEError) else error from None
        used = {name: version for name, version in report.versions.items() if name not in _UNUSED}
        self.versions |= {**used, "onnxruntime": sandbox.runtime}
        return report, actions

    def _advanced(self, done: int, states: int) -> None:
        """Report the progress over the states of all policies."""
        if self._progress is not None:
            policies = sum(run.artefact is not None for run in self._runs)
            self._progress(states * self._evaluated + done, states * policies)


def agent_names(spec: SMESpec) -> list[str]:
    """The agents of a team, in the order of the channels that they own; none without a team."""
    return [] if spec.team is None else [agent.name for agent in spec.team.agents]


class _CheckedPolicy:
    """A sandboxed policy as `evaluate` calls it: region by region, batch by batch, for each agent.

    In each region, a random batch and the last one, which is often smaller, are checked for
    dependence on other rows, and the random one for dependence on the observations' last place.
    """

    def __init__(self, sandbox: Sandbox, states: int, agents: int) -> None:
        self._sandbox, self._states, self._agents = sandbox, states, agents
        self._random = np.random.default_rng(secrets.randbits(128))
        self._begin_region()

    def _begin_region(self) -> None:
        self._first = self._calls = 0
        self._batch_with = int(self._random.integers(self._states))

    def __call__(self, observations: Observations) -> Actions:
        end = self._first + len(observations)
        is_chosen = self._first <= self._batch_with < end
        if is_chosen or end == self._states:
            self._sandbox.check_rows(observations, _SINGLE_ROWS)
        if is_chosen:
            self._sandbox.check_last_place(observations)
        a = self._sandbox(observations)
        self._calls += 1
        if self._calls % self._agents == 0:
            self._first = end
            if end == self._states:
                self._begin_region()
        return a


@dataclass(frozen=True, eq=False)
class _Actions:
    """A run's actions in one half: `[B, A]`, and their u; 0 if constant."""

    a: _Array
    u: float


class Behaviours:
    """The behaviour of a submission's runs, in the order in which they are observed."""

    def __init__(self, protocol: EvaluationProtocol, submission: str) -> None:
        self._protocol, self._submission = protocol, submission
        self._runs: dict[str, list[tuple[str, list[_Actions]]]] = defaultdict(list)

    def observe(self, run: str, spec: SMESpec, policy: Callable[[Any], Any]) -> str | None:
        """Reject (`run_repeated`) a run like one before; digest its actions in board states."""
        prepared = as_policy(policy, spec, action_range="unit")
        actions = self._actions(spec, prepared, self._submission)
        for earlier, others in self._runs[spec.digest]:
            for where, one, other in zip(_WHERE, actions, others, strict=True):
                _refuse_repeated(earlier, where, one, other)
        self._runs[spec.digest].append((run, actions))
        shared = self._actions(spec, prepared, "")
        if not all(half.u for half in shared):
            return None
        data = b"".join(half.a.astype("<f4").tobytes() for half in shared)
        return f"sha256:{hashlib.sha256(data).hexdigest()}"

    def _actions(
        self, spec: SMESpec, policy: Callable[[Any], _Array], states_of: str
    ) -> list[_Actions]:
        """The actions inside and outside, in the states of a submission, or of the board ("")."""
        optimal_action = engine(materialize(spec)).optimal_action
        actions = []
        for observations in _observations(spec, self._protocol, states_of):
            a = np.clip(policy(observations), 0.0, 1.0)
            optimal = optimal_action(observations[:, : spec.state_dim].astype(np.float64))
            variation = float(np.abs(a - a.mean(axis=0)).mean())
            error = float(np.abs(a - optimal).mean())
            u = 0.0 if variation < CONSTANT else min(variation, max(error, FLOOR))
            actions.append(_Actions(a, u))
        return actions


def _refuse_repeated(earlier: str, where: str, one: _Actions, other: _Actions) -> None:
    u = min(one.u, other.u)
    if not u:
        return
    distance, least = float(np.abs(one.a - other.a).mean()), max(FRACTION * u, FLOOR)
    if distance <= least:
        raise Rejection(
            "run_repeated",
            f"mean |a − a'|={distance:.2g} {where} the training cube, where a' are the actions of "
            f"{earlier} in the same states: must be above {least:.2g}. Runs are independent "
            "trainings: a method that gives nearly the same policy for every seed is one run on "
            "each instance. List it once, or train each run on data of its own.",
        )


def _observations(
    spec: SMESpec, protocol: EvaluationProtocol, states_of: str
) -> list[npt.NDArray[np.float32]]:
    """`[B, S + 2]` observations in uniform states inside the training cube, and outside it."""
    S, T = spec.state_dim, spec.horizon
    text = "\n".join((protocol.digest, spec.digest, states_of))
    bits = np.random.PCG64(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))
    halves = []
    for reach in (1.0, 1.0 + protocol.edges[-1][1]):
        # Unlike a `Generator`'s, the same for every version of NumPy.
        u = (bits.random_raw(STATES * (S + 2)) >> np.uint64(11)).reshape(STATES, S + 2) * 2.0**-53
        x, radius, time = 2.0 * u[:, :S] - 1.0, u[:, S], u[:, S + 1]
        if reach > 1.0:
            x *= (1.0 + radius * (reach - 1.0))[:, None] / np.abs(x).max(axis=1, keepdims=True)
        observations = np.zeros((STATES, S + 2), np.float32)
        observations[:, :S] = 0.5 + x / 2.0
        observations[:, S] = np.floor(time * T) / T
        halves.append(observations)
    return halves
