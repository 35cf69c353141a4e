"""`certify`: checks of a drawn task, to reject a bad draw before training.

Source: METHOD, sections 1, 2, 8 and 9. Axis letters: `S` state_dim, `A` action_dim, `N` lanes or
states, `m` distractors. A check passes inside one range, warns inside a wider one (a correct but
easy task), and refuses outside both.

The ranges of difficulty come from 4,560 draws (40 seeds of 114 settings; S 1..64, A 1..16,
L 1..20). Mean r̃ of ½ is 0.716 to 0.752 where L = 1 and 0.646 to 0.848 with `unit_variance` and
S ≥ 8, of which 97 % pass; 0.824 to 0.891 with `semi_orthogonal`, S = 8, A = 4, L = 2, which all
warn; and 0.878 to 0.975 at S = A = 2, L = 2, of which 95 % are refused.

At S = 8, A = 4, τ = 0.2, the share of broken limits over τ is 0.79 to 1.31 in 40 draws for L = 1
and for 10 layers with `unit_variance`, and 0.04 to 0.51 for 2 `semi_orthogonal` ones. A mixing's
condition number is 5.7 at 8 channels and depth 1, 2,840 at 128 channels and depth 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from rich.markup import escape
from scipy.special import ndtr

from sme_registry.io import integer_in
from sme_registry.io.markup import Table, card, table_html
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task.draw import Array, Layer, uniform
from sme_registry.task.loading import check_memory, load_task
from sme_registry.task.task import Task, through

Outcome = Literal["passed", "warning", "refused", "reported"]

MARKS: dict[Outcome, str] = {
    "passed": "[green]passed[/]",
    "warning": "[yellow]warning[/]",
    "refused": "[red]refused[/]",
    "reported": "[dim]reported[/]",
}
"""The outcomes in colour, with Rich's markup."""

_STATES = 20_000  # the standard error of mean r̃ is then below 0.001
_LANES = 4_096
_MIXING_STEPS = 100
_TOGETHER = 256
_CELLS = 16
_BLOCK = 4_096  # states: a deep policy's inner layers of all states would not fit in cache
_DISTRACTOR_STEPS = 1_000
_CONSTANT_STEPS = 2_000
_CHANNELS_FOLLOWED = 256
_FALSE_ALARM = 1e-6  # chance that one of the channels of a uniform ensemble is beyond the bound
_MEASURED_CHANNELS = 512  # above it the fit and the Jacobians take longer than everything else
_LARGEST_CONDITION = 5_000.0
_SINGULAR = 1.0 / float(np.finfo(np.float64).eps)  # of a matrix that float64 cannot invert
_LINEAR_LIMIT = 1_024  # above it the least-squares fit takes longer than everything else
_ROUNDING = 1e-9

MEANINGS = {
    "transition_row_sums": "How far a row of W is from the sum 1, which keeps an action's mass.",
    "layers_orthogonal": "How far W/√12 of a layer of {} is from semi-orthogonal (rescaled: from "
    "unit rows).",
    "layers_centred": "How far a layer's b is from −½ W 1, which keeps its outputs around ½.",
    "uniform_states": "Largest √N·KS distance of a state channel from uniform, "
    f"{_MIXING_STEPS} random actions after uniform starts.",
    "coverage": f"Smallest share of the {_CELLS} × {_CELLS} cells of two neighbouring state "
    "channels that these states lie in.",
    "coverage_from_one_start": f"Smallest share of {_CELLS} cells of a state channel that "
    f"{_TOGETHER} lanes reach by the same number of random actions, all from one start.",
    "distinct_states": "Smallest share of distinct values of a state channel, over "
    f"{_CONSTANT_STEPS:,} steps of one constant action and over {{}} lanes after them: floating "
    "point must not collapse.",
    "constant_policy_similarity": "Mean r̃ of the constant action ½ over uniform states; near 0.75 "
    "where π* spreads over its range. Higher: the target is near-trivial. Lower: it sits in "
    "corners.",
    "constant_policy_reward": "Mean step reward of the constant action ½, which an agent earns "
    "without learning.",
    "channel_spread": "Smallest standard deviation of a channel of π* over uniform states; 0.289 "
    "where it is uniform, 0 where the channel has collapsed to a constant.",
    "agent_constant_policy_similarity": "Mean r̃ of ½ over one agent's own channels: of {}, where "
    "it is farthest from 0.75.",
    "linear_policy_reward": "Mean step reward of the least-squares linear policy, which needs no "
    "deep learning. It has no range: it is high at complexity 1 by construction.",
    "broken_limits": "Share of uniform states and channels in which π* is above its limit; near "
    "the tightness, {:g}, where π* and v spread over their range. Lower: the limits matter "
    "little. Higher: they bind more than the tightness says.",
    "limit_uniformity": "Largest KS distance of a channel of v, and so of a limit, from uniform "
    "over uniform states; 0.5 where the limit has collapsed to a constant.",
    "states_with_a_broken_limit": "Share of uniform states in which π* is above the limit of at "
    "least one channel.",
    "price_of_safety": "What the safe projection forgoes of the largest step reward, on average "
    "over uniform states; a planner may forgo less.",
    "distractor_row_sums": "How far a row of the distractors' W is from the sum 1, as for the "
    "state.",
    "uniform_distractors": "Largest √N·KS distance of a distractor from uniform, "
    f"{_DISTRACTOR_STEPS:,} random actions after uniform starts.",
    "mixing_orthogonal": "How far a layer's W is from a multiple of an orthogonal matrix (of √12 "
    "where it is nonlinear), which can be inverted without loss.",
    "mixing_centred": "How far a layer is from mapping the centre of the cube to the centre.",
    "mixing_condition": "Median condition number of the mixing's Jacobian at {} uniform points: "
    "by how much inverting it can multiply an error of the float32 observation.",
    "mixing_linear_r2": "R² of the worst channel of state and distractors that a linear map "
    "recovers from the observation, on the other half of the states; 1 where the mixing is "
    "linear.",
    "mixing_extent": "Width of the image of the cube in its widest channel: 1, since an "
    "observation must fill [0, 1] and stay inside.",
}
"""Each check, in a sentence for the reader; `{}` is a detail of the task."""
MEANINGS["distinct_distractors"] = MEANINGS["distinct_states"].replace(
    "a state channel", "a distractor"
)


@dataclass(frozen=True)
class Check:
    """One measured number of a task, and the range in which it passes.

    A warning is of an easy task, or one whose limits bind more or less often than its tightness
    says; refused is a broken or trivial one; only reported are numbers without a range.
    """

    name: str
    value: float | None  # None where it was not measured; `meaning` gives the reason
    low: float | None  # None where there is no bound on that side
    high: float | None
    outcome: Outcome
    meaning: str  # one sentence for the reader


@dataclass(frozen=True)
class Certificate:
    """The result of `certify`."""

    digest: str  # of the spec
    seed: int  # of the states and actions that it was measured with; not the task's
    checks: tuple[Check, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst of the checks: "passed", "warning" or "refused"."""
        if self.of("refused"):
            return "refused"
        return "warning" if self.of("warning") else "passed"

    @property
    def passed(self) -> bool:
        """Whether no check refuses the task; warnings pass."""
        return self.outcome != "refused"

    def of(self, outcome: Outcome) -> tuple[Check, ...]:
        """The checks with this outcome."""
        return tuple(check for check in self.checks if check.outcome == outcome)

    def table(self, title: str) -> Table:
        """The checks as a table: outcome, name, value, range and meaning."""
        columns = {"": "name", "check": "name", "value": "number", "passes in": "name"}
        table = Table(title, {**columns, "meaning": "text"})
        for check in self.checks:
            bounds = filter(None, (short(check.low, "≥ "), short(check.high, "≤ ")))
            cells = MARKS[check.outcome], f"[bold]{check.name}[/]", short(check.value)
            table.add_row(*cells, ", ".join(bounds), escape(check.meaning))
        return table

    def _repr_html_(self) -> str:
        return card(table_html(self.table(f"{self.digest}\n{self.outcome}")))

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON data."""
        return {
            "digest": self.digest,
            "seed": self.seed,
            "outcome": self.outcome,
            "passed": self.passed,
            "checks": [asdict(check) for check in self.checks],
        }


def short(value: float | None, sign: str = "") -> str:
    """A number of three digits after a sign, `≤ 0.8`; empty where there is none."""
    return "" if value is None else f"{sign}{value:.3g}"


def certify(task: Task | SpecLike, *, seed: int = 0) -> Certificate:
    """Measure a drawn task. The same task and seed give the same certificate.

    `seed`, in [0, 2⁵³), is that of the states and actions to measure with. Where the certificate
    has not `passed`, the task should not be used. In a notebook it shows as a card.

    Examples:
      >>> from sme_registry.task import certify
      >>> certify("Default").passed
      True
    """
    seed = integer_in("seed", seed, 0, 2**53 - 1, advice="Leave it out for 0.")
    task = load_task(task)
    S, A, m = task.spec.state_dim, task.spec.action_dim, task.spec.distractors
    lanes = max(256, min(_LANES, 2**24 // (S * A)))
    states = max(2_000, min(_STATES, 2**26 // (S + m + task.spec.hidden_width)))
    check_memory(
        48 * max(lanes, states) * (S + A + m + task.spec.hidden_width),
        f"Certifying a task of state_dim={S}, action_dim={A}, distractors={m}",
        "Certify a task of the same kind with fewer channels.",
    )
    checks = (
        *_parameters(task),
        *_mixing(task, seed, lanes),
        _no_collapse(task, seed, task.transition, S, "distinct_states"),
        *_difficulty(task, seed, states),
        *_limits(task, seed, states),
        *_observation(task, seed, states),
    )
    return Certificate(task.spec.digest, seed, checks)


def _check(
    name: str,
    value: Any,
    low: float | None = None,
    high: float | None = None,
    *,
    warns: tuple[float, float] = (math.inf, -math.inf),
    detail: object = "",
) -> Check:
    """A number that passes in [low, high], warns in a wider range, and else refuses the task."""
    outcome: Outcome = "refused"
    if low is None and high is None:
        outcome = "reported"
    elif (low is None or low <= value) and (high is None or value <= high):
        outcome = "passed"
    elif warns[0] <= value <= warns[1]:
        outcome = "warning"
    return Check(name, float(value), low, high, outcome, MEANINGS[name].format(detail))


def _not_measured(name: str, reason: str) -> Check:
    return Check(name, None, None, None, "reported", f"Not measured: {reason}.")


def _constant(name: str, similarity: Any, detail: str = "") -> Check:
    return _check(name, similarity, 0.65, 0.80, warns=(0.60, 0.90), detail=detail)


def _numbers(task: Task, seed: int, name: str, *shape: int) -> Array:
    """Uniform numbers for measuring, independent of every stream that tasks are drawn from."""
    label = f"certify/{task.spec.digest}/{name}"
    return uniform(seed, label, math.prod(shape)).reshape(shape)


def _in_blocks(function: Callable[[Array], Array], s: Array) -> Array:
    blocks = [function(s[i : i + _BLOCK]) for i in range(0, len(s), _BLOCK)]
    return np.concatenate(blocks)


def _parameters(task: Task) -> Iterator[Check]:
    layers = [layer for network in (*task.policies, task.limiting) for layer in network]
    unit_rows = task.spec.policy_init == "unit_variance"
    orthogonality = max(_orthogonality_error(layer, unit_rows) for layer in layers)
    network = "π* or v" if task.limiting else "π*"
    yield _check("transition_row_sums", _row_sum_error(task.W), high=0.0)
    yield _check("layers_orthogonal", orthogonality, high=_ROUNDING, detail=network)
    yield _check("layers_centred", max(map(_centre_error, layers)), high=_ROUNDING)


def _row_sum_error(W: Array) -> float:
    return float(np.abs(W.sum(axis=1) - 1.0).max())


def _orthogonality_error(layer: Layer, unit_rows: bool) -> float:
    W = layer.W / math.sqrt(12.0)
    out, inputs = W.shape
    if out > inputs and unit_rows:
        return float(np.abs(np.linalg.norm(W, axis=1) - 1.0).max())
    gram = W.T @ W if out > inputs else W @ W.T
    return float(np.abs(gram - np.eye(len(gram))).max())


def _mixing(task: Task, seed: int, lanes: int) -> Iterator[Check]:
    """Where random actions lead an ensemble of uniform starts, and one of a single start."""
    S, A = task.spec.state_dim, task.spec.action_dim
    s = _numbers(task, seed, "states", lanes, S)
    together = np.repeat(_numbers(task, seed, "start", 1, S), _TOGETHER, axis=0)
    for t in range(_MIXING_STEPS):
        a = _numbers(task, seed, f"actions/{t}", lanes, A)
        s, together = task.transition(s, a), task.transition(together, a[:_TOGETHER])
    yield _check("uniform_states", _distance_from_uniform(s), high=_uniform_bound(S))
    yield _check("coverage", _coverage(s, pairs=S > 1), low=0.95 if lanes == _LANES else 0.5)
    # No range: a channel into which the actions put little may stay in a nearly invariant set.
    yield _check("coverage_from_one_start", _coverage(together, pairs=False))


def _coverage(s: Array, *, pairs: bool) -> float:
    """Smallest share of cells that `[N, S]` states lie in, of a channel or two neighbours."""
    cells = np.minimum((s * _CELLS).astype(np.int64), _CELLS - 1)
    if pairs:
        cells = cells[:, :-1] * _CELLS + cells[:, 1:]
    return min(len(np.unique(column)) for column in cells.T) / _CELLS ** (2 if pairs else 1)


def _difficulty(task: Task, seed: int, states: int) -> Iterator[Check]:
    """How far from trivial π* is: the scores of policies that know nothing, and its spread."""
    s = _numbers(task, seed, "difficulty", states, task.spec.state_dim)
    optimal = _in_blocks(task.policy, s)
    constant = np.full_like(optimal, 0.5)
    similarity = task.similarity_of(constant, optimal)
    reward, spread = task.reward_of(similarity).mean(), optimal.std(axis=0).min()
    yield _constant("constant_policy_similarity", similarity.mean())
    yield _check("constant_policy_reward", reward, high=0.30, warns=(-math.inf, 0.60))
    yield _check("channel_spread", spread, low=0.15, warns=(0.05, math.inf))
    if task.spec.team is not None:
        # The mean over all channels would hide an agent that has nothing to learn among others.
        means = task.similarities_of(constant, optimal).mean(axis=0)
        agent = int(np.abs(means - 0.75).argmax())
        yield _constant("agent_constant_policy_similarity", means[agent], task.names[agent])
    yield _linear_policy(task, s, optimal)


def _linear_policy(task: Task, s: Array, optimal: Array) -> Check:
    """The mean step reward of the best affine policy, fitted on one half, scored on the other."""
    S, half = task.spec.state_dim, len(s) // 2
    if S > _LINEAR_LIMIT or half < 4 * (S + 1):
        reason = f"a fit over state_dim={S} channels takes too long"
        return _not_measured("linear_policy_reward", reason)
    actions = np.clip(_held_out(s, optimal), 0.0, 1.0)
    reward = task.reward_of(task.similarity_of(actions, optimal[half:])).mean()
    return _check("linear_policy_reward", reward)


def _limits(task: Task, seed: int, states: int) -> Iterator[Check]:
    tau = task.spec.tightness
    if not tau:
        return
    s = _numbers(task, seed, "limits", states, task.spec.state_dim)
    optimal, limit = _in_blocks(task.policy, s), _in_blocks(task.limit, s)
    v = _in_blocks(lambda block: through(task.limiting, block), s)
    broken = optimal > limit
    uniformity = _distance_from_uniform(v) / math.sqrt(states)
    warns = 0.25 * tau, 2.0 * tau
    yield _check("broken_limits", broken.mean(), 0.5 * tau, 1.5 * tau, warns=warns, detail=tau)
    yield _check("limit_uniformity", uniformity, 0.0, 0.2, warns=(0.0, 0.4))
    yield _check("states_with_a_broken_limit", broken.any(axis=1).mean())
    yield _check("price_of_safety", 1.0 - task.safe_reward_of(optimal, limit).mean())


def _observation(task: Task, seed: int, states: int) -> Iterator[Check]:
    if task.distractor_transition is not None:
        yield from _distractors(task, seed, task.distractor_transition[0])
    if task.mixing:
        yield from _mixing_map(task, seed, states)


def _distractors(task: Task, seed: int, W: Array) -> Iterator[Check]:
    """Autonomous distractors always move under random actions; driven ones under any agent's."""
    m, A = task.spec.distractors, task.spec.action_dim
    lanes = max(256, min(_LANES, 2**20 // (m * A)))
    d = _numbers(task, seed, "distractors", lanes, m)
    for t in range(_DISTRACTOR_STEPS):
        d = task.distractor_step(d, _numbers(task, seed, f"distractors/actions/{t}", lanes, A))
    yield _check("distractor_row_sums", _row_sum_error(W), high=0.0)
    yield _check("uniform_distractors", _distance_from_uniform(d), high=_uniform_bound(m))
    yield _no_collapse(task, seed, task.distractor_step, m, "distinct_distractors")


def _mixing_map(task: Task, seed: int, states: int) -> Iterator[Check]:
    linear = task.spec.mixing == "orthogonal"
    orthogonality = max(_multiple_error(layer, None if linear else 12.0) for layer in task.mixing)
    centre = max(_centre_error(layer, 0.5 if linear else 0.0) for layer in task.mixing)
    yield _check("mixing_orthogonal", orthogonality, high=_ROUNDING)
    yield _check("mixing_centred", centre, high=_ROUNDING)
    n = task.spec.state_dim + task.spec.distractors
    yield from _invertibility(task, _numbers(task, seed, "mixing", states, n))
    if linear:
        extent = float(np.abs(task.mixing[0].W).sum(axis=1).max())
        yield _check("mixing_extent", extent, 1.0 - _ROUNDING, 1.0 + _ROUNDING)


def _multiple_error(layer: Layer, scale: float | None) -> float:
    """How far W Wᵀ is from `scale` times the identity, relative to it; None: from any multiple."""
    gram = layer.W @ layer.W.T
    scale = scale or float(np.trace(gram)) / len(gram)
    return float(np.abs(gram / scale - np.eye(len(gram))).max())


def _centre_error(layer: Layer, centre: float = 0.0) -> float:
    return float(np.abs(layer.b - (centre - 0.5 * layer.W.sum(axis=1))).max())


def _invertibility(task: Task, x: Array) -> Iterator[Check]:
    """How well x is recovered from M(x): locally, and by one linear map."""
    (N, n), S = x.shape, task.spec.state_dim
    if n > _MEASURED_CHANNELS or 4 * (n + 1) > N // 2:
        for name in ("mixing_condition", "mixing_linear_r2"):
            yield _not_measured(name, f"it takes too long for {n:,} channels")
        return
    points = x[: max(8, min(100, 2**22 // n**2))]
    condition = min(float(np.median(np.linalg.cond(_jacobians(task, points)))), _SINGULAR)
    yield _check("mixing_condition", condition, high=_LARGEST_CONDITION, detail=len(points))
    r2 = held_out_r2(task.seen(x[:, :S], x[:, S:]), x).min()
    yield _check("mixing_linear_r2", r2, low=0.75)


def _jacobians(task: Task, x: Array) -> Array:
    """The Jacobian of the mixing `[P, n, n]` at points `[P, n]`."""
    J = np.broadcast_to(np.eye(x.shape[1]), (*x.shape, x.shape[1]))
    for W, b in task.mixing:
        J = W @ J
        if task.spec.mixing == "nonlinear":
            z = x @ W.T + b
            J = (np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi))[:, :, None] * J
            x = ndtr(z)
    return J


def _distance_from_uniform(s: Array) -> float:
    """The largest √N · KS distance of the marginals of `[N, C]` numbers from U(0, 1)."""
    N = len(s)
    ranked = np.sort(s, axis=0)
    steps = np.arange(N)[:, None] / N
    return float(math.sqrt(N) * np.maximum(ranked - steps, steps + 1.0 / N - ranked).max())


def _uniform_bound(channels: int) -> float:
    """Kolmogorov's bound on √N · KS distance, shared out over the channels (Bonferroni)."""
    return math.sqrt(0.5 * math.log(2.0 * channels / _FALSE_ALARM))


def _no_collapse(
    task: Task, seed: int, transition: Callable[[Array, Array], Array], channels: int, name: str
) -> Check:
    """The smallest share of distinct values of a channel under four constant actions."""
    # A dyadic b with a dyadic action would merge all lanes within 52 steps; float32 states would
    # cycle within about 2,000.
    A = task.spec.action_dim
    stream = "distractors/" if name == "distinct_distractors" else ""
    lanes = max(8, min(64, 2**20 // (channels * A)))
    starts = _numbers(task, seed, f"{stream}constant_starts", lanes, channels)
    action = _numbers(task, seed, f"{stream}constants", 1, A)
    constants = np.concatenate([*(np.full_like(action, c) for c in (0.0, 0.5, 1.0)), action])
    a = np.repeat(constants, lanes, axis=0)
    s = np.tile(starts, (len(constants), 1))
    history = np.empty((_CONSTANT_STEPS, len(constants), min(channels, _CHANNELS_FOLLOWED)))
    for t in range(_CONSTANT_STEPS):
        s = transition(s, a)
        history[t] = s[::lanes, : history.shape[2]]
    last = s.reshape(len(constants), lanes, channels).swapaxes(0, 1)
    return _check(name, min(_distinct(history), _distinct(last)), low=0.99, detail=lanes)


def _distinct(values: Array) -> float:
    ranked = np.sort(values, axis=0)
    return float((1 + (np.diff(ranked, axis=0) > 0).sum(axis=0)).min()) / len(values)


def held_out_r2(h: Array, y: Array) -> Array:
    """R² `[c]` of y `[n, c]` by an affine map of h `[n, H]`: fitted on one half, of the other."""
    held_out = y[len(h) // 2 :]
    missed = ((_held_out(h, y) - held_out) ** 2).sum(axis=0)
    return np.asarray(1.0 - missed / ((held_out - held_out.mean(axis=0)) ** 2).sum(axis=0))


def _held_out(h: Array, y: Array) -> Array:
    """The second half of y, by an affine map of h that is fitted to the first half."""
    half = len(h) // 2
    design = np.concatenate([h, np.ones((len(h), 1))], axis=1)
    return np.asarray(design[half:] @ np.linalg.lstsq(design[:half], y[:half])[0])
