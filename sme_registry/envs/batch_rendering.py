"""`BatchRenderer`: frames of the chosen lanes of a batch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from sme_registry.envs import arguments, infos
from sme_registry.envs.rendering import HEIGHT, WIDTH, Frame, Renderer
from sme_registry.envs.types import Array
from sme_registry.errors import OptionError
from sme_registry.io import integer_in

if TYPE_CHECKING:
    from sme_registry.envs.batch import Batch, BatchStep

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}


class BatchRenderer:
    """Draws the present episodes of some lanes; for a team, of the whole team.

    Args:
      batch: the batch.
      lanes: the lanes to draw; None draws each of them.
      space: of the joint actions, in the environment's range.

    Raises:
      OptionError: a lane is no integer in [0, B).
      MissingDependencyError: pygame is not installed.
    """

    def __init__(
        self, batch: Batch, lanes: Sequence[int] | None, space: gymnasium.spaces.Box
    ) -> None:
        chosen = range(batch.lanes) if lanes is None else lanes
        if not isinstance(chosen, list | tuple | range | np.ndarray) or len(chosen) == 0:
            raise OptionError(f"render_lanes={lanes!r}: must be a list of lanes, such as [0, 1].")
        chosen = [integer_in("render_lanes", lane, 0, batch.lanes - 1) for lane in chosen]
        self._batch, self._space = batch, space
        self._renderers = {
            lane: Renderer(batch.task_of(lane), "rgb_array", METADATA) for lane in chosen
        }

    def record(
        self, began: Iterable[int], unit: Array | None = None, step: BatchStep | None = None
    ) -> None:
        """Record a reset in the lanes that began an episode, and a step in the others.

        Args:
          began: the lanes that have just begun an episode.
          unit: `[B, A]` actions of the unit range; None after a reset, which has no step.
          step: the result of that step.
        """
        states, reset = self._batch.state, set(began)
        for lane, renderer in self._renderers.items():
            view: Any = SimpleNamespace(
                state=states[lane],
                action_space=self._space,
                sme_spec=self._batch.task_of(lane).spec,
            )
            if lane in reset:
                renderer.record(view, None)
            elif unit is not None and step is not None:
                rescaled = bool(self._space.low[0] < 0.0)
                action = arguments.from_unit(unit[lane], rescaled)
                renderer.record(view, (action, infos.of_all_agents(step, lane, rescaled)))

    def frames(self) -> tuple[Frame, ...]:
        """The present frames of the chosen lanes, each `[H, W, 3]` uint8.

        Raises:
          EpisodeError: before the first reset.
        """
        frames = (renderer.frame() for renderer in self._renderers.values())
        return tuple(frame for frame in frames if frame is not None)  # None is for windows only

    def frame_of_each(self) -> tuple[Frame, ...]:
        """A frame of each lane, `B` of them; those of lanes not chosen are the same white frame."""
        blank = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        drawn = dict(zip(self._renderers, self.frames(), strict=True))
        return tuple(drawn.get(lane, blank) for lane in range(self._batch.lanes))


def batch_renderer(
    render_mode: str | None,
    lanes: Sequence[int] | None,
    batch: Batch,
    space: gymnasium.spaces.Box,
) -> BatchRenderer | None:
    """The renderer of a batched environment's arguments; None if it has no `render_mode`.

    Raises:
      OptionError: another mode than "rgb_array", invalid lanes, or lanes without a mode.
      MissingDependencyError: pygame is not installed.
    """
    if render_mode not in (None, "rgb_array"):
        raise OptionError(
            f"render_mode={render_mode!r}: must be None or 'rgb_array' for a batch. Create a "
            "single environment to watch an episode in a window."
        )
    if render_mode is None and lanes is not None:
        raise OptionError("render_lanes: needs render_mode='rgb_array'. Add it.")
    return None if render_mode is None else BatchRenderer(batch, lanes, space)
