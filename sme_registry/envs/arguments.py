"""Checks of the arguments of environments: documents, actions, seeds, options, states, limits.

The action range "unit" is [0, 1]; "symmetric" is [−1, 1], rescaled by a = (u + 1)/2. It belongs to
a run's record, not to the task's digest.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.errors import (
    ActionError,
    OptionError,
    SpecError,
    StateError,
    UnexpectedKeywordError,
    did_you_mean,
)
from sme_registry.io import choice, integer_in
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.catalogue import NAMESPACE, symmetric_name, unique_name
from sme_registry.spec.sme_spec import ACTION_RANGES, SpecLike
from sme_registry.task import Task
from sme_registry.task.loading import load_task
from sme_registry.task.task import Array, Mask

MAX_LIFETIME = 2**62  # at which a life may begin: its steps are counted in 64 bits


def load_team(environment: type, spec: SpecLike, overrides: dict[str, Any]) -> Task:
    """The task of a class of team environments that is called with overrides of spec fields."""
    check_overrides(environment, None, overrides)
    task = load_task(spec, **overrides)
    for field in ("safety", "observation"):
        if getattr(task.spec, field) is not None:
            raise SpecError(
                f"{field}: not supported for teams. Use sme_registry.make, or leave it out."
            )
    return task


def agents_problem(by_agent: Mapping[str, Any], agents: Sequence[str], what: str) -> str:
    """What is missing or too much among actions or policies by agent; empty if nothing is."""
    missing = [name for name in agents if name not in by_agent]
    unknown = [name for name in by_agent if name not in agents]
    problems = [f"{', '.join(missing)}: {what} missing."] if missing else []
    if unknown:
        hint = did_you_mean(str(unknown[0]), missing or agents)
        problems.append(f"{', '.join(map(repr, unknown))}: no such agent.{hint}")
    if problems:
        problems.append(f"Give one for each of {', '.join(agents)}.")
    return " ".join(problems)


def check_overrides(
    environment: type, document: SMESpec | StreamSpec | None, overrides: dict[str, Any]
) -> None:
    """Raise UnexpectedKeywordError on a keyword that is no field of a spec; streams have none."""
    is_stream = isinstance(document, StreamSpec)
    fields = [] if is_stream else list(SMESpec.model_fields)
    for name in [name for name in overrides if name not in fields]:
        parameters = inspect.signature(environment).parameters.values()
        keywords = [one.name for one in parameters if one.kind is one.KEYWORD_ONLY]
        advice = did_you_mean(name, [*keywords, *fields]) or " Remove it."
        if is_stream and name in {*SMESpec.model_fields, *StreamSpec.model_fields}:
            advice = f" {another_stream(name)}"
        allowed = ", ".join(keywords)
        if fields:
            allowed += f" or a field of the spec ({', '.join(fields)})"
        raise UnexpectedKeywordError(
            f"{environment.__name__}() got an unexpected keyword argument {name!r}"
            f"{' for a stream' if is_stream else ''}: must be {allowed}.{advice}"
        )


def another_stream(field: str) -> str:
    """What to do in order to change a field of a stream, or of its specs."""
    if field in StreamSpec.model_fields:
        return (
            "It is a field of streams: to change it, make another stream in Python, such as "
            f"`StreamSpec(**dict(stream) | {{{field!r}: …}})`."
        )
    return (
        "It is a field of specs: to change it, make another stream in Python, such as "
        f"`StreamSpec(phases=[{{'spec': phase.spec.derive({field}=…), 'steps': phase.steps}} "
        "for phase in stream.phases])`."
    )


def action_space(action_range: str, action_dim: int) -> tuple[gymnasium.spaces.Box, bool]:
    """The action space `[A]` of a range, and whether its actions must be rescaled."""
    choice("action_range", action_range, ACTION_RANGES)
    low = 0.0 if action_range == "unit" else -1.0
    return gymnasium.spaces.Box(low, 1.0, (action_dim,), np.float32), low < 0.0


def to_unit(
    action: Any, shape: tuple[int, ...], rescaled: bool, ignored: Mask | None = None
) -> Array:
    """Actions `[…]` as float64 of the unit range, not clipped; rows `ignored` `[B]` become zero."""
    try:
        array = np.asarray(action)
    except (ValueError, TypeError, RuntimeError) as error:  # of PyTorch: a gradient, or a GPU
        text = f"action={action!r:.80}: must be an array of shape {shape}: {error}"
        raise ActionError(text) from None
    if array.dtype.kind not in "fiu":
        raise ActionError(f"action={action!r:.80}: must be numbers, got dtype {array.dtype}.")
    if array.shape != shape:
        raise ActionError(f"action of shape {array.shape}: must be of shape {shape}.")
    array = np.array(array, dtype=np.float64, order="C")
    if ignored is not None:
        array[ignored] = 0.0
    if rescaled:  # in place: a temporary array of a large batch costs as much as the arithmetic
        array += 1.0
        array /= 2.0
    return array


class RangeWarning:
    """Warns once of actions far below 0 in the unit range, those of an actor with tanh outputs."""

    # Noise added to an action at the boundary seldom goes further.
    FAR_BELOW, EVERY = -0.1, 32

    def __init__(self, document: SMESpec | StreamSpec, rescaled: bool) -> None:
        self._document, self._is_over, self._wait = document, rescaled, 0

    def is_due(self) -> bool:
        """True once in 32 calls, the first included: a check costs as much as a step."""
        self._wait = (self._wait + 1) % self.EVERY
        return self._wait == 1 and not self._is_over

    def check(self, actions: Array) -> None:
        if not (actions < self.FAR_BELOW).any():
            return
        self._is_over = True
        symmetric = f"{NAMESPACE}/{symmetric_name(unique_name(self._document))}"
        id_too = f', or make "{symmetric}"' if symmetric in gymnasium.registry else ""
        warn_of_clipping(id_too)


def warn_of_clipping(id_too: str = "") -> None:
    gymnasium.logger.warn(
        "actions below 0 are clipped to 0, as the action range is [0, 1]. If your actor's are in "
        f'[-1, 1], such as those of tanh, use action_range="symmetric"{id_too}.'
    )


def from_unit(unit: npt.NDArray[Any], rescaled: bool) -> npt.NDArray[Any]:
    if not rescaled:
        return unit
    symmetric = 2.0 * unit
    symmetric -= 1.0
    return symmetric


def not_finite_error() -> ActionError:
    return ActionError("action: has NaN or infinite entries. Give finite numbers.")


def checked_seed(seed: Any) -> int | None:
    """A seed of an environment's generator: None, or an integer of at least 0."""
    advice = "Leave it out to continue the generator's stream."
    return None if seed is None else integer_in("seed", seed, 0, advice=advice)


def check_options(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    if not isinstance(options, Mapping | None):
        raise OptionError(f"options={options!r:.80}: must be a dictionary, by name.")
    for name in options or {}:
        if name not in known:
            raise OptionError(
                f"options={{{name!r}: …}}: unknown option.{did_you_mean(str(name), known)} "
                f"Known: {', '.join(known)}."
            )


def lifetime_in(options: dict[str, Any] | None) -> int | None:
    """The option `lifetime` of a stream's reset: an integer in [0, 2⁶²]; None without it."""
    if not options or "lifetime" not in options:
        return None
    advice = "Leave it out to continue the life."
    return integer_in("lifetime", options["lifetime"], 0, MAX_LIFETIME, advice=advice)


def initial_values(
    name: str, options: dict[str, Any], shape: tuple[int, ...], num_envs: int | None = None
) -> Array | None:
    """The option `state` or `distractors` of a reset, `[*shape]` or `[B, *shape]`, or None."""
    if name not in options:
        return None
    if num_envs is None:
        return initial_states(options[name], shape, name)
    one_for_all = np.asarray(options[name], dtype=object).ndim == len(shape)
    value = initial_states(options[name], shape if one_for_all else (num_envs, *shape), name)
    return np.broadcast_to(value, (num_envs, *shape))


def initial_states(state: Any, shape: tuple[int, ...], name: str = "state") -> Array:
    """States at which episodes begin, as float64 of `shape`; StateError outside [0, 1]."""
    try:
        array = np.asarray(state, dtype=np.float64)
    except (TypeError, ValueError):
        raise StateError(f"{name}={state!r:.80}: must be an array of shape {shape}.") from None
    if array.shape != shape:
        raise StateError(f"{name} of shape {array.shape}: must be of shape {shape}.")
    outside = ~((array >= 0.0) & (array <= 1.0))
    if outside.any():
        raise StateError(
            f"{name}: entry {array[outside][0]} lies outside [0, 1]. To ask the task about "
            "values outside the cube, use env.unwrapped.task."
        )
    return array


def single_agent(task: Task) -> Task:
    if len(task.policies) > 1:
        raise SpecError(
            f"team: this task is for {len(task.policies)} agents and Gymnasium's environments are "
            "for one. Use sme_registry.make_parallel or sme_registry.make_aec."
        )
    return task


def check_has_limits(who: str, spec: SMESpec) -> None:
    if spec.safety is None:
        raise OptionError(
            f"{who}: needs a task with limits, and this one has none. Give a task with safety, "
            "such as Safety20."
        )


def outer_time_limit(horizon: int) -> Any:
    """The TimeLimit below the horizon around the environment whose `reset` calls this, or None.

    The environment truncates the episode with it, since it alone can pay r_cum. Where wrappers
    between the two repeat actions, the limit's own count says when.
    """
    # An environment has no reference to its wrappers; but each calls the `reset` of the environment
    # inside it, so the callers' frames up to the first that is no reset are theirs.
    limits, frame = [], sys._getframe(2)
    while frame is not None and "reset" in frame.f_code.co_name:
        wrapper = frame.f_locals.get("self")
        if isinstance(wrapper, gymnasium.wrappers.TimeLimit):
            limits.append(wrapper)
        frame = frame.f_back  # type: ignore[assignment]  # typed as never None
    below = [limit for limit in limits if limit._max_episode_steps < horizon]
    return min(below, key=lambda limit: limit._max_episode_steps, default=None)
