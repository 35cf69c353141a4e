"""`SMEStreamVectorEnv`: a batch of lives of one stream, stepped as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium.vector import AutoresetMode

from sme_registry.envs import arguments
from sme_registry.envs.stream_batch import StreamBatch
from sme_registry.envs.vector import SMEVectorEnv
from sme_registry.errors import EpisodeError
from sme_registry.spec import ActionRange, SMESpec, StreamLike, StreamSpec
from sme_registry.task import Task


class SMEStreamVectorEnv(SMEVectorEnv):
    """`num_envs` lives of one stream, bit-equal to as many `SMEStreamEnv`s with the same seeds.

    Lanes live by themselves: with early termination they are at different steps of their lives, and
    near a switch in different phases. `get_attr("task")` gives the task in force in each lane, and
    `task` that of all of them. The option `lifetime` of a reset is that of `SMEStreamEnv`, for each
    lane that is reset.

    Args:
      stream: the stream, its fields, an id, a digest or a path.
      num_envs: B, the lanes, at least 1.
      action_range, autoreset_mode, render_mode, render_lanes, max_episode_steps: as `SMEVectorEnv`.
      **overrides: none; see `SMEStreamEnv`.

    Raises:
      SpecError, UnknownNameError, ResourceLimitError, OptionError: as `SMEStreamEnv`.
      WrapperError: `max_episode_steps` is below the horizon.

    Examples:
      >>> from sme_registry.envs import SMEStreamVectorEnv
      >>> envs = SMEStreamVectorEnv("Switch5", num_envs=2)
      >>> observations, infos = envs.reset(seed=0)
      >>> observations.shape
      (2, 10)
    """

    _batch: StreamBatch

    def __init__(
        self,
        stream: StreamLike = "Switch5-v1",
        num_envs: int = 1,
        *,
        action_range: ActionRange = "unit",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_lanes: Sequence[int] | None = None,
        max_episode_steps: int | None = None,
        **overrides: Any,
    ) -> None:
        super().__init__(
            stream,  # type: ignore[arg-type]  # `_load` takes it
            num_envs,
            action_range=action_range,
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
            render_lanes=render_lanes,
            max_episode_steps=max_episode_steps,
            **overrides,
        )

    def _load(self, spec: Any, num_envs: int, overrides: dict[str, Any]) -> StreamBatch:
        return StreamBatch(arguments.load_stream_tasks(type(self), spec, overrides), num_envs)

    @property
    def stream(self) -> StreamSpec:
        """The stream."""
        return self._batch.document

    @property
    def task(self) -> Task:
        """The task in force.

        Raises:
          EpisodeError: the lanes are in different pieces of the stream.
        """
        task = self._batch.one_task
        if task is None:
            raise EpisodeError(
                "task: the lanes are in different pieces of the stream. Ask for that of each lane, "
                "get_attr('task')."
            )
        return task

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task in force; errors as `task`."""
        return self.task.spec
