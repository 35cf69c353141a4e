"""The expected dynamic regret of lives in which nobody learns, without living through them.

    E D = Σ over the pieces of the life of  n · E[Σ_i (1 − r_i)] / E[length]     n: steps of a piece

The expectations are over episodes of a policy on the piece's task, from uniform states. They run in
parallel, so a life costs as much as a few thousand steps. Where a switch waits for a reset and no
episode ends early, as in the catalogue, E D is exact but for the sampling error; a seed makes it
repeatable. With early termination, or a switch within an episode, what differs is the episode at a
switch: the piece after it begins in a state that the episode before left, or a few steps later.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.evaluation.continual.dynamic_regret import DynamicRegret, dynamic_regret
from sme_registry.evaluation.continual.retention import final_specs, prepared, refuse_other_count
from sme_registry.evaluation.evaluate import same_draw
from sme_registry.evaluation.measure import Progress
from sme_registry.evaluation.policies import Policy
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import integer_in
from sme_registry.spec import StreamLike, StreamSpec
from sme_registry.task import load, materialize_stream

EPISODES = 5000


def expected_regret(
    life: Sequence[Any],
    stream: StreamLike,
    *,
    episodes: int = EPISODES,
    seed: int = 0,
    action_range: str | None = None,
    algorithm: str | None = None,
    progress: Progress | None = None,
) -> DynamicRegret:
    """The expected dynamic regret of a life in which given policies act and do not learn.

    Args:
      life: for each visit the policy that acts in it, in any form that `evaluate` accepts; or a
        number, the online regret of an agent that learned in it.
      stream: a stream, its fields, an id, a digest or a path.
      episodes: run with each policy, over the pieces of one cycle; each has one or more. The
        standard error of a policy's online regret is about 0.02/√episodes.
      seed: of the initial states, which are the same for every policy.
      action_range: as in `evaluate`, of all policies.
      algorithm: as in `evaluate`.
      progress: called after the episodes of each piece with the number of pieces done, and of all.

    Examples:
      >>> from sme_registry.evaluation import expected_regret
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> regret = expected_regret(["constant", "constant"], stream, episodes=10)
      >>> 0 < regret.dynamic_regret < 200
      True
    """
    stream = load(stream, StreamSpec)
    stream.refuse_many_visits()
    P = len(stream.phases)
    refuse_other_count("life", life, stream.cycles * P, "or number for each visit")
    integer_in("episodes", episodes, 1)
    integer_in("seed", seed, 0)
    policies = _policies(life, stream, action_range, algorithm)
    steps = np.diff([*(piece.start for piece in stream.pieces), stream.cycle_steps])
    of_phase = [[i for i, one in enumerate(stream.pieces) if one.phase == j] for j in range(P)]
    parts = [(each, piece) for v, each in enumerate(life) for piece in of_phase[v % P]]

    # A policy acts once in each piece, in however many cycles.
    acts = dict.fromkeys((id(each), piece) for each, piece in parts if id(each) in policies)
    tasks = materialize_stream(stream) if acts else ()
    means: dict[tuple[int, int], float] = {}
    for which, piece in acts:
        states = start_states(seed, piece, _share(episodes, steps, piece), stream.state_dim)
        policy = policies[which]
        if stream.observes_phase:
            policy = policy.in_phase(stream.pieces[piece].phase, P)
        ran = rollouts(policy, tasks[piece], states)
        means[which, piece] = ran.per_step(ran.regret)
        if progress is not None:
            progress(len(means), len(acts))
    ends = _ends(stream, np.cumsum(steps[[piece for _, piece in parts]]))
    lengths = np.diff(ends, prepend=0)
    regret = np.array([means.get((id(each), piece), each) for each, piece in parts])
    lived = lengths > 0
    return dynamic_regret(stream, ends[lived], regret[lived], lengths[lived])


def reference_regret(
    stream: StreamLike,
    *,
    frozen: Any = None,
    training: DynamicRegret | None = None,
    episodes: int = EPISODES,
    seed: int = 0,
) -> dict[str, DynamicRegret]:
    """The dynamic regret of the reference agents, by their names in `report.LABELS`.

    Args:
      stream: as in `expected_regret`.
      frozen: an agent's policy at the end of its first visit, for the agent that stops learning
        then; None leaves it out.
      training: that agent's dynamic regret, of which the first visit is taken.
      episodes, seed: as in `expected_regret`.

    Examples:
      >>> from sme_registry.evaluation import reference_regret
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> sorted(reference_regret(sme_registry.StreamSpec(phases=phases), episodes=10))
      ['constant_half', 'fresh_optimum', 'frozen_optimum']
    """
    stream = load(stream, StreamSpec)
    stream.refuse_many_visits()
    if (frozen is None) != (training is None):
        raise OptionError(
            "frozen, training: must be given together or both left out. Give the policy at the "
            "end of the first visit and the dynamic regret of the training."
        )
    V = stream.visits
    first = final_specs(stream)[0]
    # No regret in the task of which it is the optimum, also where this rounds observations.
    optimum = reference_policy("optimal", first)
    own = [
        phase.drift is None and same_draw(phase.spec) == same_draw(first) for phase in stream.phases
    ]
    lives: dict[str, list[Any]] = {
        "frozen_optimum": [0.0 if mine else optimum for mine in own] * stream.cycles,
        "fresh_optimum": [0.0] * V,
        "constant_half": [reference_policy("constant_half", first)] * V,
    }
    if training is not None:
        learned = training.visits[0].online_regret
        if learned is None:
            raise OptionError(
                "training: has no steps in visit 0. Give the dynamic regret of a whole life."
            )
        acting = prepared(frozen, stream, "frozen")
        lives["frozen_agent"] = [learned, *[acting] * (V - 1)]
    return {
        name: expected_regret(life, stream, episodes=episodes, seed=seed)
        for name, life in lives.items()
    }


def _policies(
    life: Sequence[Any], stream: StreamSpec, action_range: str | None, algorithm: str | None
) -> dict[int, Policy]:
    """The policies of a life by their identity, prepared."""
    policies: dict[int, Policy] = {}
    for v, each in enumerate(life):
        if isinstance(each, Real | np.bool_):
            if isinstance(each, bool | np.bool_) or not 0.0 <= float(each) <= 1.0:
                raise OptionError(f"life[{v}]={each}: must be a policy, or a regret in [0, 1].")
        elif id(each) not in policies:
            policies[id(each)] = prepared(each, stream, f"life[{v}]", action_range, algorithm)
    return policies


def _ends(stream: StreamSpec, ends: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """When pieces are left: where a switch waits for a reset, at the end of an episode."""
    if stream.switch == "step" or any(phase.spec.D for phase in stream.phases):
        return ends
    T = stream.horizon
    return np.minimum(-(-ends // T) * T, stream.steps)


def _share(episodes: int, steps: npt.NDArray[np.int64], piece: int) -> int:
    """A piece's share in the episodes of a cycle, at least 1."""
    return -(-episodes * int(steps[piece]) // int(steps.sum()))
