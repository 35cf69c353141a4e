"""`certify`: checks of a drawn task, to reject a bad draw before training.

Source: METHOD, sections 1 and 2. Axis letters: `S` state_dim, `A` action_dim, `N` lanes or states.
`certify_safety` and `certify_observation` have the checks of specs with these fields.

A check passes inside one range, warns inside a wider one, and refuses outside both. A warning means
that a task is correct but easy: the constant action ½ is near its optimum, as METHOD says of
`semi_orthogonal` policies of 2 to 5 layers. A broken or trivial task is refused.

The ranges of difficulty come from 4,560 draws (40 seeds of 114 settings; S 1..64, A 1..16,
L 1..20). Mean r̃ of the constant policy: smallest, median, largest. Spread: smallest, median.

    setting                                  r̃ of ½             spread        passed  refused
    L = 1, A ≤ S                             0.716 0.744 0.752  0.282 0.292   100 %   0 %
    unit_variance, S ≥ 8                     0.646 0.748 0.848  0.145 0.267    97 %   0 %
    unit_variance, S 2..4                    0.584 0.747 0.964  0.042 0.227    73 %   3 %
    semi_orthogonal, S ≥ 16                  0.736 0.750 0.832  0.130 0.273    92 %   0 %
    semi_orthogonal, S = 8, A = 4, L = 2     0.824 0.869 0.891  0.052 0.119     0 %   0 %
    semi_orthogonal, S = 8, A = 4, L = 5     0.758 0.790 0.828  0.112 0.199    68 %   0 %
    semi_orthogonal, S = 8, A = 4, L = 10    0.724 0.747 0.805  0.203 0.258    98 %   0 %
    semi_orthogonal, S = A = 2, L = 2        0.878 0.933 0.975  0.004 0.050     0 %  95 %
    semi_orthogonal, S = A = 2, L = 3        0.840 0.917 0.974  0.017 0.076     0 %  68 %
    semi_orthogonal, A > S, L = 1            0.784 0.803 0.854  0.015 0.164    20 %   3 %
    S = 1, L > 1, unit_variance              0.531 0.799 0.990  0.011 0.220    33 %  30 %
"""

from __future__ import annotations

import math

import numpy as np

from sme_registry.io import integer_in
from sme_registry.spec import SpecLike
from sme_registry.task import memory
from sme_registry.task.certificate import INF, Certificate, Check, judged, numbers, reported
from sme_registry.task.certify_observation import observation_checks
from sme_registry.task.certify_safety import safety_checks
from sme_registry.task.draw import Array, Layer
from sme_registry.task.loading import load_task
from sme_registry.task.task import Task
from sme_registry.task.uniformity import (
    CONSTANT_STEPS,
    distance_from_uniform,
    distinct_share,
    lanes_followed,
    uniform_bound,
)

STATES = 20_000  # the standard error of mean r̃ is then below 0.001
LANES = 4_096
MIXING_STEPS = 100
_TOGETHER = 256
_CELLS = 16
_BLOCK = 4_096  # states
_LINEAR_LIMIT = 1_024  # above it the least-squares fit takes longer than everything else
_ROUNDING = 1e-9
_CONSTANT_PASSES, _CONSTANT_WARNS = (0.65, 0.80), (0.60, 0.90)  # mean r̃ of the action ½


def certify(task: Task | SpecLike, *, seed: int = 0) -> Certificate:
    """Measure a drawn task. The same task and seed give the same certificate.

    `seed`, in [0, 2⁵³), is that of the states and actions to measure with. Where the certificate
    has not `passed`, the task should not be used.
    """
    seed = integer_in("seed", seed, 0, 2**53 - 1, advice="Leave it out for 0.")
    if not isinstance(task, Task):
        task = load_task(task)
    S, A, m = task.spec.state_dim, task.spec.action_dim, task.spec.distractors
    lanes = max(256, min(LANES, 2**24 // (S * A)))
    states = max(2_000, min(STATES, 2**26 // (S + m + task.spec.hidden_width)))
    distractors = f", distractors={m}" if m else ""
    memory.refuse_above_limit(
        48 * max(lanes, states) * (S + A + m + task.spec.hidden_width),
        f"Certifying a task of state_dim={S}, action_dim={A}{distractors}",
        "Certify a task of the same kind with fewer channels.",
    )
    checks = (
        *_parameters(task),
        *_mixing(task, seed, lanes),
        _no_collapse(task, seed),
        *_difficulty(task, seed, states),
        *safety_checks(task, seed, states),
        *observation_checks(task, seed, states),
    )
    return Certificate(task.spec.digest, seed, checks)


def _parameters(task: Task) -> tuple[Check, ...]:
    every = [layer for network in (*task.policies, task.limiting) for layer in network]
    network = "π* or v" if task.limiting else "π*"
    unit_rows = task.spec.policy_init == "unit_variance"
    return (
        judged(
            "transition_row_sums",
            float(np.abs(task.W.sum(axis=1) - 1.0).max()),
            "How far a row of W is from the sum 1, which keeps an action's mass.",
            passes=(-INF, 0.0),
        ),
        judged(
            "layers_orthogonal",
            max(_orthogonality_error(layer, unit_rows) for layer in every),
            f"How far W/√12 of a layer of {network} is from semi-orthogonal (rescaled: from unit "
            "rows).",
            passes=(-INF, _ROUNDING),
        ),
        judged(
            "layers_centred",
            max(float(np.abs(layer.b + 0.5 * layer.W.sum(axis=1)).max()) for layer in every),
            "How far a layer's b is from −½ W 1, which keeps its outputs around ½.",
            passes=(-INF, _ROUNDING),
        ),
    )


def _orthogonality_error(layer: Layer, unit_rows: bool) -> float:
    W = layer.W / math.sqrt(12.0)
    out, inputs = W.shape
    if out > inputs and unit_rows:
        return float(np.abs(np.linalg.norm(W, axis=1) - 1.0).max())
    gram = W.T @ W if out > inputs else W @ W.T
    return float(np.abs(gram - np.eye(len(gram))).max())


def _mixing(task: Task, seed: int, lanes: int) -> tuple[Check, ...]:
    """Where random actions lead an ensemble of uniform starts, and one of a single start.

    The second need not become uniform within an episode: a channel into which the actions put
    little may stay in a nearly invariant set. So it has no range.
    """
    S, A = task.spec.state_dim, task.spec.action_dim
    s = numbers(task, seed, "states", lanes, S)
    together = np.repeat(numbers(task, seed, "start", 1, S), _TOGETHER, axis=0)
    for t in range(MIXING_STEPS):
        a = numbers(task, seed, f"actions/{t}", lanes, A)
        s, together = task.transition(s, a), task.transition(together, a[:_TOGETHER])
    return (
        judged(
            "uniform_states",
            distance_from_uniform(s),
            f"Largest √N·KS distance of a state channel from uniform, {MIXING_STEPS} random "
            "actions after uniform starts.",
            passes=(-INF, uniform_bound(S)),
        ),
        judged(
            "coverage",
            _coverage(s, pairs=S > 1),
            f"Smallest share of the {_CELLS} × {_CELLS} cells of two neighbouring state channels "
            "that these states lie in.",
            passes=(0.95 if lanes == LANES else 0.5, INF),
        ),
        reported(
            "coverage_from_one_start",
            _coverage(together, pairs=False),
            f"Smallest share of {_CELLS} cells of a state channel that {_TOGETHER} lanes reach by "
            f"the same number of random actions, all from one start.",
        ),
    )


def _coverage(s: Array, *, pairs: bool) -> float:
    """Smallest share of cells that `[N, S]` states lie in, of a channel or two neighbours."""
    cells = np.minimum((s * _CELLS).astype(np.int64), _CELLS - 1)
    if pairs:
        cells = cells[:, :-1] * _CELLS + cells[:, 1:]
    return min(len(np.unique(column)) for column in cells.T) / _CELLS ** (2 if pairs else 1)


def _no_collapse(task: Task, seed: int) -> Check:
    S, A = task.spec.state_dim, task.spec.action_dim
    lanes = lanes_followed(S, A)
    starts = numbers(task, seed, "constant_starts", lanes, S)
    return judged(
        "distinct_states",
        distinct_share(task.transition, starts, numbers(task, seed, "constants", 1, A)),
        f"Smallest share of distinct values of a state channel, over {CONSTANT_STEPS:,} steps of "
        f"one constant action and over {lanes} lanes after them: floating point must not collapse.",
        passes=(0.99, INF),
    )


def _difficulty(task: Task, seed: int, states: int) -> list[Check]:
    """How far from trivial π* is: the scores of policies that know nothing, and its spread."""
    s = numbers(task, seed, "difficulty", states, task.spec.state_dim)
    # In blocks: a deep policy's inner layers of all states would not fit in cache.
    optimal = np.concatenate([task.policy(s[i : i + _BLOCK]) for i in range(0, states, _BLOCK)])
    constant = np.full_like(optimal, 0.5)
    similarity = task.similarity_of(constant, optimal)
    checks = [
        judged(
            "constant_policy_similarity",
            float(similarity.mean()),
            "Mean r̃ of the constant action ½ over uniform states; near 0.75 where π* spreads over "
            "its range. Higher: the target is near-trivial. Lower: it sits in corners.",
            passes=_CONSTANT_PASSES,
            warns=_CONSTANT_WARNS,
        ),
        judged(
            "constant_policy_reward",
            float(task.reward_of(similarity).mean()),
            "Mean step reward of the constant action ½, which an agent earns without learning.",
            passes=(-INF, 0.30),
            warns=(-INF, 0.60),
        ),
        judged(
            "channel_spread",
            float(optimal.std(axis=0).min()),
            "Smallest standard deviation of a channel of π* over uniform states; 0.289 where it "
            "is uniform, 0 where the channel has collapsed to a constant.",
            passes=(0.15, INF),
            warns=(0.05, INF),
        ),
    ]
    if task.spec.team is not None:
        # The mean over all channels would hide an agent that has nothing to learn among others.
        means = task.similarities_of(constant, optimal).mean(axis=0)
        agent = int(np.abs(means - 0.75).argmax())
        checks.append(
            judged(
                "agent_constant_policy_similarity",
                float(means[agent]),
                f"Mean r̃ of ½ over one agent's own channels: of {task.names[agent]}, where it is "
                "farthest from 0.75.",
                passes=_CONSTANT_PASSES,
                warns=_CONSTANT_WARNS,
            )
        )
    return [*checks, _linear_policy(task, s, optimal)]


def _linear_policy(task: Task, s: Array, optimal: Array) -> Check:
    """The mean step reward of the best affine policy, fitted on one half, scored on the other."""
    S, half = task.spec.state_dim, len(s) // 2
    name = "linear_policy_reward"
    if S > _LINEAR_LIMIT or half < 4 * (S + 1):
        meaning = f"Not measured: a fit over state_dim={S} channels takes too long."
        return reported(name, None, meaning)
    affine = np.concatenate([s, np.ones((len(s), 1))], axis=1)
    fitted, *_ = np.linalg.lstsq(affine[:half], optimal[:half], rcond=None)
    actions = np.clip(affine[half:] @ fitted, 0.0, 1.0)
    value = task.reward_of(task.similarity_of(actions, optimal[half:])).mean()
    meaning = (
        "Mean step reward of the least-squares linear policy, which needs no deep learning. It "
        "has no range: it is high at complexity 1 by construction."
    )
    return reported(name, float(value), meaning)
