"""`Renderer`: frames of an episode, with state, actions, similarity and regret."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.envs import arguments
from sme_registry.envs.batch import Batch, BatchStep
from sme_registry.envs.schedule import ScheduleMixin
from sme_registry.errors import EpisodeError, OptionError
from sme_registry.io import integer_in, require_packages
from sme_registry.io.markup import card, folded, pairs_html
from sme_registry.spec import SMESpec, StreamSpec, cards
from sme_registry.spec.catalogue import title
from sme_registry.task import Task
from sme_registry.task.task import Array

if TYPE_CHECKING:
    import pygame

Frame = npt.NDArray[np.uint8]
_Colour = tuple[int, int, int]

RENDER_MODES = ["human", "rgb_array"]
METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

WIDTH, HEIGHT = 800, 520
_MARGIN = 24
_CHANNELS_SHOWN = 128  # of each kind; more would be narrower than two pixels

# Colours that the colour-blind can tell apart (Okabe and Ito's), on white.
_PAPER, _INK, _FAINT, _TRACK = (255, 255, 255), (40, 44, 52), (120, 126, 136), (228, 231, 236)
_OPTIMAL, _ACTION, _REGRET, _STATE = (0, 158, 115), (0, 114, 178), (213, 94, 0), (110, 128, 160)


def _import_pygame() -> Any:
    require_packages("render_mode", {"pygame": "pygame"}, "render")
    # With some versions of setuptools, importing pygame warns; the user cannot avoid that.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pygame
        import pygame.font
    return pygame


class Renderer:
    """Draws the episode, a team's as one: recording is cheap, frames are drawn on request."""

    def __init__(self, mode: str, metadata: dict[str, Any], rescaled: bool) -> None:
        self._pygame = _import_pygame()
        self._mode, self._fps, self._rescaled = mode, metadata["render_fps"], rescaled
        self._window: pygame.Surface | None = None
        self._begun = False

    # A copy keeps the recorded steps, and opens a new window.
    def __getstate__(self) -> dict[str, Any]:
        dropped = ("_pygame", "_window", "_clock", "_surface", "_small", "_normal")
        return {name: value for name, value in self.__dict__.items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _pygame=_import_pygame(), _window=None)

    def record(
        self, state: Array, task: Task, unit: Array | None, info: dict[str, Any] | None
    ) -> None:
        """Record a step, its action `[A]` of the unit range and its info; or (None) a reset."""
        self._state, self._spec = state, task.spec  # a stream's task may change
        self._owned = task.owned if task.spec.team else ()
        if unit is None or info is None:
            self._begun = True
            self._similarities: list[float] = []
            self._regrets: list[float] = [0.0]
            self._earned = self._pending = self._payout = 0.0
            self._action: npt.NDArray[np.float64] | None = None
            self._optimal: npt.NDArray[np.float64] | None = None
        else:
            self._action = arguments.from_unit(np.clip(unit, 0.0, 1.0), self._rescaled)
            self._optimal = info["optimal_action"].copy()
            self._similarities.append(info["similarity"])
            self._regrets.append(self._regrets[-1] + info["regret"])
            self._earned += info["step_reward"]
            self._payout = self._pending + info["step_reward"] - info["accumulated_reward"]
            self._pending = info["accumulated_reward"]
        if self._mode == "human":
            self._show()

    def frame(self) -> Frame:
        if not self._begun:
            raise EpisodeError("render: the episode has not begun. Call reset() first.")
        surface = self._pygame.Surface((WIDTH, HEIGHT))
        self._draw(surface)
        # pygame's arrays are [W, H, 3].
        return np.ascontiguousarray(self._pygame.surfarray.pixels3d(surface).swapaxes(0, 1))

    def close(self) -> None:
        if self._window is not None:
            self._window = None
            self._pygame.display.quit()

    def _show(self) -> None:
        pg = self._pygame
        if self._window is None:
            try:
                pg.display.init()
                self._window = pg.display.set_mode((WIDTH, HEIGHT))
            except pg.error as error:
                raise OptionError(
                    f"render_mode='human': no window can be opened here ({error}). "
                    "Use render_mode='rgb_array'."
                ) from None
            pg.display.set_caption(title(self._spec))
            self._clock = pg.time.Clock()
        self._draw(self._window)
        pg.event.pump()
        pg.display.flip()
        self._clock.tick(self._fps)

    def _draw(self, surface: pygame.Surface) -> None:
        # Fonts do not outlive pygame.quit(), which other environments call when they close.
        self._pygame.font.init()
        self._small, self._normal = (self._pygame.font.Font(None, size) for size in (18, 22))
        self._surface = surface
        surface.fill(_PAPER)
        right, half = WIDTH - _MARGIN, WIDTH // 2
        self._text(_title(self._spec), (_MARGIN, 18), _INK, self._normal)
        self._progress(_MARGIN, 44, right)
        self._states(_MARGIN, 96, half - 20, 250)
        self._actions(half + 20, 96, right, 250)
        self._numbers(288)
        left_box, right_box = (_MARGIN, 374, half - 20, 492), (half + 20, 374, right, 492)
        self._curve(left_box, "similarity", self._similarities, 1.0, _ACTION)
        top_value = max(self._regrets[-1], 1.0)
        self._curve(right_box, "regret", self._regrets, top_value, _REGRET)

    def _rect(self, colour: _Colour, box: tuple[int, int, int, int], radius: int = -1) -> None:
        """Fill `(x, y, width, height)`."""
        self._pygame.draw.rect(self._surface, colour, box, border_radius=radius)

    def _progress(self, left: int, y: int, right: int) -> None:
        T, t, width = self._spec.horizon, len(self._similarities), right - left - 90
        self._rect(_TRACK, (left, y, width, 6), 3)
        if t:
            self._rect(_INK, (left, y, max(6, width * t // T), 6), 3)
        self._text(f"t = {t} / {T}", (right, y - 3), _INK, self._small, align=1.0)

    def _states(self, left: int, top: int, right: int, bottom: int) -> None:
        self._heading("state", self._spec.state_dim, left, top)
        height = bottom - top - 22
        for x, width, value in _columns(self._state[:_CHANNELS_SHOWN].tolist(), left, right):
            filled = round(height * value)
            self._rect(_TRACK, (x, bottom - height, width, height), 2)
            self._rect(_STATE, (x, bottom - filled, width, filled), 2)
        self._text("0 … 1", (right, top), _FAINT, self._small, align=1.0)

    def _actions(self, left: int, top: int, right: int, bottom: int) -> None:
        """Each action as a dot, the optimal one as a bar; the line between them is the error."""
        A, height = self._spec.action_dim, bottom - top - 22
        self._heading("last action", A, left, top)
        columns = _columns([0.0] * min(A, _CHANNELS_SHOWN), left, right)
        for x, width, _ in columns:
            self._rect(_TRACK, (x, bottom - height, width, height), 2)
        for channels in self._owned:
            if owned := columns[channels]:
                end = owned[-1][0] + owned[-1][1]
                self._rect(_FAINT, (owned[0][0], bottom + 4, end - owned[0][0], 3))
        if self._action is None or self._optimal is None:
            return
        x = right
        low = -1.0 if self._rescaled else 0.0
        legend = (f"{low:.0f} … 1", _FAINT), ("optimal", _OPTIMAL), ("taken", _ACTION)
        for word, colour in legend:
            x -= self._text(word, (x, top), colour, self._small, align=1.0) + 10
        scale = height / (1.0 - low)
        actions = self._action[:_CHANNELS_SHOWN].tolist()
        for (x, width, _), a, best in zip(columns, actions, self._optimal.tolist(), strict=False):
            middle = x + width // 2
            y = bottom - round((a - low) * scale)
            y_best = bottom - round((best - low) * scale)
            wide = max(1, min(6, width // 2))
            self._rect(_REGRET, (middle - wide // 2, min(y, y_best), wide, abs(y - y_best)))
            self._rect(_OPTIMAL, (x, y_best - 2, width, 4))
            radius = max(2, min(6, width // 2))
            self._pygame.draw.circle(self._surface, _ACTION, (middle, y), radius)

    def _heading(self, name: str, count: int, left: int, top: int) -> None:
        number = f"{count} channels" if count > 1 else "1 channel"
        if count > _CHANNELS_SHOWN:
            number = f"the first {_CHANNELS_SHOWN} of {count} channels"
        width = self._text(name, (left, top), _INK, self._normal)
        self._text(number, (left + width + 8, top + 2), _FAINT, self._small)

    def _numbers(self, y: int) -> None:
        last = self._similarities[-1] if self._similarities else None
        regret = self._regrets[-1] - self._regrets[-2] if self._similarities else None
        columns: Sequence[tuple[str, float | None, tuple[int, int, int]]] = (
            ("similarity", last, _ACTION),
            ("step reward", None if regret is None else 1.0 - regret, _INK),
            ("regret", regret, _REGRET),
            ("payout", self._payout if self._similarities else None, _INK),
            ("not yet paid", self._pending, _INK),
            ("return", self._earned - self._pending, _INK),
        )
        step = (WIDTH - 2 * _MARGIN) / len(columns)
        for i, (name, value, colour) in enumerate(columns):
            x = round(_MARGIN + i * step)
            self._text(name, (x, y), _FAINT, self._small)
            text = "–" if value is None else f"{value:.3f}"
            self._text(text, (x, y + 18), colour, self._normal)

    def _curve(
        self,
        box: tuple[int, int, int, int],
        name: str,
        values: Sequence[float],
        top_value: float,
        colour: _Colour,
    ) -> None:
        left, top, right, bottom = box
        self._text(f"{name} so far", (left, top - 26), _INK, self._normal)
        self._text(f"0 … {top_value:.3g}", (right, top - 24), _FAINT, self._small, align=1.0)
        surface, draw = self._surface, self._pygame.draw
        draw.line(surface, _TRACK, (left, top), (right, top))
        draw.line(surface, _FAINT, (left, bottom), (right, bottom))
        # One point a pixel at most, on the scale of the whole episode.
        stride = max(1, len(values) // (right - left))
        reach = (right - left) / max(1, self._spec.horizon)
        first = 0 if values is self._regrets else 1
        xs = [left + (i + first) * reach for i in range(0, len(values), stride)]
        ys = [bottom - (bottom - top) * min(value / top_value, 1.0) for value in values[::stride]]
        points = list(zip(xs, ys, strict=True))
        for start, end in itertools.pairwise(points):
            draw.line(surface, colour, start, end, 2)
        if points:
            draw.circle(surface, colour, points[-1], 4)

    def _text(
        self,
        text: str,
        place: tuple[int, int],
        colour: _Colour,
        font: pygame.font.Font,
        align: float = 0.0,
    ) -> int:
        """Write a line whose top left (`align` 0) or top right (1) is `place`; its width."""
        image = font.render(text, True, colour)
        self._surface.blit(image, (round(place[0] - align * image.get_width()), place[1]))
        return image.get_width()


def _title(spec: SMESpec) -> str:
    """The axes by their symbols, and the name of the task."""
    parts = [f"SME   S = {spec.state_dim}", f"A = {spec.action_dim}", f"L = {spec.complexity}"]
    rest = {"k": spec.k, "r_min": spec.r_min, "D": spec.D}
    parts += [f"{name} = {value:g}" for name, value in rest.items()]
    if spec.team is not None:
        parts.append(f"mean of {len(spec.team.agents)} agents")
    return "   ".join([*parts, title(spec)])


def _columns(values: Sequence[float], left: int, right: int) -> list[tuple[int, int, float]]:
    """`(x, width, value)` of each channel's column, shared out over the pixels of a panel."""
    pitch = min((right - left) / len(values), 44.0)
    width = max(1, round(pitch - min(8.0, pitch / 4)))
    return [(round(left + i * pitch), width, value) for i, value in enumerate(values)]


class RenderMixin(ScheduleMixin):
    """Frames of an episode; pygame is imported when the first is recorded."""

    metadata: dict[str, Any]
    render_mode: str | None
    _rescaled: bool
    _renderer: Renderer | None = None

    def _set_render_mode(self, render_mode: str | None) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise OptionError(f"render_mode={render_mode!r}: must be None, 'human' or 'rgb_array'.")
        self.render_mode = render_mode

    def _record(
        self, state: Array, unit: Array | None = None, info: dict[str, Any] | None = None
    ) -> None:
        """Record in an environment with a render mode; see `Renderer.record`."""
        if self._renderer is None:
            assert self.render_mode is not None
            self._renderer = Renderer(self.render_mode, self.metadata, self._rescaled)
        self._renderer.record(state, self.task, unit, info)

    def render(self) -> Any:
        """The frame of this step: `[H, W, 3]` uint8 for "rgb_array"; None for "human"."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() needs a render_mode, such as "
                'sme_registry.make(..., render_mode="rgb_array").'
            )
            return None
        if self._renderer is None:
            raise EpisodeError("render: the episode has not begun. Call reset() first.")
        return None if self.render_mode == "human" else self._renderer.frame()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class BatchRenderer:
    """Draws the present episodes of some environments of a batch, a team's as one; None: of all."""

    def __init__(self, batch: Batch, envs: Sequence[int] | None, rescaled: bool) -> None:
        chosen = range(batch.num_envs) if envs is None else envs
        if not isinstance(chosen, list | tuple | range | np.ndarray) or len(chosen) == 0:
            raise OptionError(f"render_lanes={envs!r}: must be a list of lanes, such as [0, 1].")
        chosen = [integer_in("render_lanes", env, 0, batch.num_envs - 1) for env in chosen]
        self._batch, self._rescaled = batch, rescaled
        self._renderers = {env: Renderer("rgb_array", METADATA, rescaled) for env in chosen}

    def record(
        self, began: Iterable[int], unit: Array | None = None, step: BatchStep | None = None
    ) -> None:
        """Record a reset in environments that began, in others a step with actions `[B, A]`."""
        states, reset = self._batch.state, set(began)
        for env, renderer in self._renderers.items():
            task = self._batch.task_of(env)
            if env in reset:
                renderer.record(states[env], task, None, None)
            elif unit is not None and step is not None:
                info = self._batch.info_of(step, env, self._rescaled)
                renderer.record(states[env], task, unit[env], info)

    def frames(self) -> tuple[Frame, ...]:
        return tuple(renderer.frame() for renderer in self._renderers.values())

    def frame_of_each(self) -> tuple[Frame, ...]:
        """A frame of each environment; those not drawn are the same white frame."""
        blank = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        drawn = dict(zip(self._renderers, self.frames(), strict=True))
        return tuple(drawn.get(env, blank) for env in range(self._batch.num_envs))


def batch_renderer(
    render_mode: str | None,
    envs: Sequence[int] | None,
    batch: Batch,
    rescaled: bool,
) -> BatchRenderer | None:
    """The renderer of a batch's `render_mode` and `render_lanes`; None without a mode."""
    if render_mode not in (None, "rgb_array"):
        raise OptionError(
            f"render_mode={render_mode!r}: must be None or 'rgb_array' for a batch. Create a "
            "single environment to watch an episode in a window."
        )
    if render_mode is None and envs is not None:
        raise OptionError("render_lanes: needs render_mode='rgb_array'. Add it.")
    return None if render_mode is None else BatchRenderer(batch, envs, rescaled)


def html_card(
    env: Any,
    observation: Any,
    action: Any,
    *,
    status: str = "",
    autoreset: str = "",
) -> str:
    """A card of an environment, whose spaces are of a single one or of any agent in a team."""
    document: SMESpec | StreamSpec = env.document
    seen = cards.observation_text(document)
    span = f"float32 in [{action.low.flat[0]:g}, {action.high.flat[0]:g}]"
    facts = {
        "observation": f"[{observation.shape[0]}] float32 in [0, 1]: {seen}",
        "action": f"[{action.shape[0]}] {span}",
    }
    if document.specs[0].team is not None:  # whose spaces are in the table of its agents
        facts = {"actions": span}
    facts["episode"] = f"at most {document.horizon:,} steps" + (f"; {status}" if status else "")
    if autoreset:
        facts["autoreset"] = autoreset
    task = folded(cards.summary(document), *cards.parts(document))
    return card(pairs_html(repr(env), facts), task)
