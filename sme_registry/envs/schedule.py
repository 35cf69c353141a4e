"""`Schedule`: which task is in force after how many environment steps; METHOD, section 7.

A task is a stream of one segment that is never over, so every environment runs a schedule. It also
says what infos hold: NumPy's float64 at a step, and 0 under the same keys at a reset. A stream's
also has `phase` and `lifetime`, int64.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from enum import Enum
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from sme_registry.envs import arguments
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.catalogue import DYNAMICS_VERSION, NAMESPACE, content_id, resolve
from sme_registry.spec.files import Resolved
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.spec.stream import StreamLike
from sme_registry.task import Task
from sme_registry.task.loading import materialize_segments
from sme_registry.task.task import (
    ACTIONS,
    NUMBERS,
    REWARD,
    Array,
    Indices,
    Observation,
)

_ZERO = np.float64(0.0)


class StepColumns(NamedTuple):
    """What a step computes of a task."""

    rows: int  # of `values`; see `task.task`
    numbers: dict[str, int]  # keys of infos whose values are numbers, and their rows
    actions: tuple[str, ...]  # keys whose values are `[A]`, in the environment's action range

    @classmethod
    def of(cls, specs: Sequence[SMESpec]) -> StepColumns:
        def has(attribute: str) -> bool:
            return not attribute or any(getattr(spec, attribute) for spec in specs)

        rows = {name: row for row, (name, field) in enumerate(NUMBERS.items()) if has(field)}
        actions = tuple(name for name, field in ACTIONS.items() if has(field))
        numbers = {name: row for name, row in rows.items() if row != REWARD}  # infos have no reward
        return cls(max(rows.values()) + 1, numbers, actions)

    def at_reset(self, width: int) -> dict[str, Any]:
        """The info of a reset: 0 for every key, those of actions as fresh arrays `[width]`."""
        # NaN would make equal resets unequal, and the mean over the infos of a batch NaN.
        arrays = {key: np.zeros(width) for key in self.actions}
        return {**arrays, **dict.fromkeys(self.numbers, _ZERO)}

    def at_resets(self, num_envs: int, width: int) -> dict[str, Array]:
        """The info of B resets: fresh arrays of 0, of actions `[B, width]`, of numbers `[B]`."""
        arrays = {key: np.zeros((num_envs, width)) for key in self.actions}
        return arrays | {key: np.zeros(num_envs) for key in self.numbers}

    def at_step(self, actions: Array, values: Array, rescaled: bool) -> dict[str, Any]:
        """The info of a step from its `actions` `[1 or 3, …, A]` and `values` `[5 … 10, …]`."""
        info = {key: values[row] for key, row in self.numbers.items()}
        in_range = arguments.from_unit(actions, rescaled)
        for row, key in enumerate(self.actions):
            info[key] = in_range[row]
        return info


class Schedule:
    """The tasks of a spec or a stream, and when each of them is in force."""

    def __init__(self, document: SMESpec | StreamSpec, tasks: Sequence[Task]) -> None:
        self.document, self.tasks = document, tuple(tasks)  # of each segment of a cycle
        self.columns = StepColumns.of(document.specs)
        self.is_stream = isinstance(document, StreamSpec)
        self.phases = np.array([segment.phase for segment in document.segments])
        self.k = np.array([task.spec.k for task in tasks])
        # Whether a segment may end within an episode, rather than at the next reset.
        self.switches_within = document.switch == "step"
        optional = ("lifetime", self.is_stream), ("distractors", tasks[0].spec.distractors > 0)
        self.reset_options = ("state", *(name for name, exists in optional if exists))
        self.times = document.times
        self._one_hot = np.eye(self.phases[-1] + 1, document.observed_phases, dtype=np.float32)

    @classmethod
    def of(cls, task: Task) -> Schedule:
        return cls(task.spec, [task])

    @classmethod
    def load(
        cls, environment: type, document: SpecLike | StreamLike, overrides: dict[str, Any]
    ) -> Schedule:
        """The schedule of an environment class that is called with a document and overrides.

        `stream=` among the overrides takes the place of the document, as in a stream's `EnvSpec`.
        """
        overrides = dict(overrides)
        kind = StreamSpec if "stream" in overrides else None
        resolved: Resolved[Any] = resolve(overrides.pop("stream", document), kind)
        arguments.check_overrides(environment, resolved.document, overrides)
        if overrides:
            resolved = Resolved(cast("SMESpec", resolved.document).derive(**overrides))
        tasks = materialize_segments(*resolved)
        arguments.single_agent(tasks[0])
        return cls(resolved.document, tasks)

    def one_hot(self, phase: int | Indices) -> Observation:
        """What an observation in a phase ends with, `[…, P]`."""
        return cast(Observation, self._one_hot[phase])

    def life(self, phase: Any, lifetime: Any) -> dict[str, Any]:
        """What infos say of a life, or of the lives of a batch; nothing of a task's."""
        return {"phase": phase, "lifetime": lifetime} if self.is_stream else {}


class ScheduleMixin:
    _schedule: Schedule

    @property
    def document(self) -> SMESpec | StreamSpec:
        """What the environment runs: its spec, or a stream."""
        return self._schedule.document

    @property
    def task(self) -> Task:
        """The drawn task: W, b, the layers of each agent, and the equations."""
        return self._schedule.tasks[0]

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is run, overrides included."""
        return self.task.spec


class GymnasiumMixin(ScheduleMixin):
    """An environment in Gymnasium's registry."""

    _env_spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec; a derived task has an id of its own, by its content.

        Its `max_episode_steps` is the horizon.
        """
        return self._env_spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._env_spec = renamed_by_content(value, self.document)

    @property
    def stream(self) -> StreamSpec:
        """The stream that is run; an environment of a task has no such attribute."""
        if not isinstance(self.document, StreamSpec):
            raise AttributeError(f"stream: {self!r} runs a task. Its spec is sme_spec.")
        return self.document


def renamed_by_content(env_spec: EnvSpec | None, document: SMESpec | StreamSpec) -> EnvSpec | None:
    """Gymnasium's spec of an environment, as plain JSON; a derived task gets the id of its content.

    Its `max_episode_steps` is the horizon, which wrappers ask for, or a batch's limit below it; a
    TimeLimit that Gymnasium makes of it changes nothing, as the environment ends by itself.
    """
    if env_spec is None:
        return None
    fields = SMESpec.model_fields.keys()
    registered = gymnasium.registry.get(env_spec.id)
    argument = document.kind
    value = env_spec.kwargs.get(argument)
    is_named = registered is None or registered.kwargs.items() <= env_spec.kwargs.items()
    named = is_named and not fields & env_spec.kwargs.keys()

    plain = copy.deepcopy(env_spec)
    limit = plain.kwargs.get("max_episode_steps", document.horizon)
    plain.kwargs = {
        key: value.value if isinstance(value, Enum) else value
        for key, value in plain.kwargs.items()
        if key not in fields and key != "max_episode_steps"
    }
    plain.max_episode_steps = min(limit, document.horizon)
    if not named or not isinstance(value, str | dict):
        plain.kwargs[argument] = document.to_dict()
    if not named:
        plain.id = content_id(document)
        # EnvSpec derives these from the id only in its constructor.
        plain.name = plain.id.removeprefix(f"{NAMESPACE}/").rsplit("-v", 1)[0]
        plain.version = DYNAMICS_VERSION
    return plain
