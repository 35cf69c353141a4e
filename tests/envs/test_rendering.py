"""Frames: headless, of one size, of what has happened, lazily drawn; of batches, as of singles."""

import copy
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import sme_registry
from sme_registry.envs import SMEEnv, SMEVectorEnv, rendering
from sme_registry.errors import EpisodeError, MissingDependencyError, OptionError

pygame = pytest.importorskip("pygame")
ROOT = Path(sme_registry.__file__).resolve().parents[1]


def begun(name="Default", **kwargs):
    env = SMEEnv(name, render_mode="rgb_array", **kwargs)
    env.reset(seed=0)
    return env


def colours(frame):
    packed = np.unique(frame.astype(np.int64) @ [65536, 256, 1])
    return {(colour >> 16, colour >> 8 & 255, colour & 255) for colour in packed.tolist()}


def run(code, **variables):
    """Run code in a process with no display; `variables` are added to its environment."""
    display = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    kept = {name: value for name, value in os.environ.items() if name not in display}
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**kept, "PYTHONPATH": str(ROOT), **variables},
    )


@pytest.mark.parametrize(
    ("fields", "action_range"),
    [
        ({}, "symmetric"),
        ({"state_dim": 300, "action_dim": 200}, "unit"),
        ({"state_dim": 1, "action_dim": 1}, "symmetric"),
        ({"horizon": 1}, "unit"),
        ({"horizon": 2**31 - 1, "k": 1000}, "unit"),
    ],
    ids=str,
)
def test_every_frame_is_a_picture_of_one_size(fields, action_range):
    env = begun(fields, action_range=action_range)
    for step in range(2):
        frame = env.render()
        assert frame.shape == (rendering.HEIGHT, rendering.WIDTH, 3)
        assert frame.dtype == np.uint8
        assert frame.flags.c_contiguous
        shown = {rendering._OPTIMAL, rendering._ACTION, rendering._REGRET}
        assert (shown <= colours(frame)) == (step == 1)
        if step == 0:
            env.step(env.action_space.low + 0.25)


def test_frames_are_fresh_and_show_each_step_of_the_episode():
    env = begun()
    frames = [env.render()]
    for _ in range(3):
        env.step(np.full(4, 0.5, np.float32))
        frames.append(env.render())
    assert len({frame.tobytes() for frame in frames}) == 4
    again = env.render()
    np.testing.assert_array_equal(again, frames[-1])
    again[:] = 0
    np.testing.assert_array_equal(env.render(), frames[-1])
    pygame.quit()  # as another environment may do
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), frames[0])


def test_an_optimal_action_is_drawn_on_its_mark_without_any_regret_between():
    for action_range in ("unit", "symmetric"):
        env = begun("Plane1", action_range=action_range, horizon=10)
        optimal = copy.deepcopy(env).step(np.zeros(2))[4]["optimal_action"]
        env.step(optimal)
        panel = env.render()[90:260, rendering.WIDTH // 2 :]
        assert rendering._ACTION in colours(panel)
        assert rendering._REGRET not in colours(panel)
        env.step(np.clip(1.0 - optimal, -1, 1))
        assert rendering._REGRET in colours(env.render()[90:260, rendering.WIDTH // 2 :])


def test_frames_need_no_display_print_nothing_and_leave_the_process_alone():
    done = run(
        "import os, sme_registry\n"
        "from sme_registry.errors import OptionError\n"
        "before = dict(os.environ)\n"
        "env = sme_registry.make('Default', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "assert env.render().any()\n"
        "env.close()\n"
        "changed = {name for name in os.environ if os.environ[name] != before.get(name)}\n"
        "print(sorted(changed))\n"
        "try:\n"
        "    sme_registry.make('Default', render_mode='human').reset()\n"
        "except OptionError as error:\n"
        "    print(error)\n",
        SDL_VIDEODRIVER="x11",
    )
    assert (done.stderr, done.returncode) == ("", 0)
    assert done.stdout.startswith("[]\n")
    assert "Use render_mode='rgb_array'" in done.stdout


def test_human_mode_shows_a_window_at_each_step():
    done = run(
        "import numpy as np, pygame, sme_registry\n"
        "env = sme_registry.make('Plane1', render_mode='human', horizon=3)\n"
        "env.reset(seed=0)\n"
        "shown = []\n"
        "for _ in range(3):\n"
        "    env.step(np.zeros(2, np.float32))\n"
        "    shown.append(pygame.surfarray.array3d(pygame.display.get_surface()).tobytes())\n"
        "    assert env.render() is None\n"
        "assert len(set(shown)) == 3\n"
        "env.close()\n"
        "assert not pygame.display.get_init()\n"
        "env.reset(seed=0)\n"
        "assert pygame.display.get_surface() is not None\n"
        "env.close()\n",
        SDL_VIDEODRIVER="dummy",
    )
    assert done.returncode == 0, done.stderr


def test_what_cannot_be_rendered_is_a_typed_error(monkeypatch):
    with pytest.raises(EpisodeError, match="reset"):
        SMEEnv("Default", render_mode="rgb_array").render()
    with pytest.raises(OptionError, match="render_mode='ansi'"):
        SMEEnv("Default", render_mode="ansi")
    for name in ("pygame", "pygame.font"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"\[render\]"):
        SMEEnv("Default", render_mode="rgb_array").reset()


# Lanes drift apart, and payouts are late.
TASK = sme_registry.SMESpec(horizon=6, k=4, D=0.1, seed=4)


def drawn(lanes=3, **kwargs):
    return SMEVectorEnv(TASK, lanes, render_mode="rgb_array", **kwargs)


@pytest.mark.parametrize(
    ("mode", "action_range"),
    [("NextStep", "symmetric"), ("SameStep", "unit"), ("Disabled", "unit")],
)
def test_frames_are_those_of_single_environments(mode, action_range):
    batch = drawn(2, autoreset_mode=mode, action_range=action_range)
    make = lambda: SMEEnv(TASK, render_mode="rgb_array", action_range=action_range)  # noqa: E731
    singles = SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode(mode))
    for env in (batch, singles):
        env.reset(seed=1)
        env.action_space.seed(0)
    np.testing.assert_array_equal(batch.render(), singles.render())
    for _ in range(8):
        action = batch.action_space.sample()
        _, _, terminated, truncated, _ = batch.step(action)
        singles.step(action)
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            for env in (batch, singles):
                env.reset(options={"reset_mask": ended.copy()})
        np.testing.assert_array_equal(batch.render(), singles.render())


def test_lanes_that_are_not_chosen_share_one_white_frame():
    few, each = drawn(4, render_lanes=[2]), drawn(4)
    for env in (few, each):
        env.reset(seed=0)
        env.step(np.full((4, 4), 0.3, np.float32))
    frames = few.render()
    assert frames is not None
    assert len(frames) == 4
    assert frames[0] is frames[3]
    assert (frames[0] == 255).all()
    assert frames[0].shape == frames[2].shape
    np.testing.assert_array_equal(frames[2], each.render()[2])  # type: ignore[index]


def test_frames_need_a_mode_a_reset_and_lanes_that_exist():
    assert SMEVectorEnv(TASK, 2).render() is None
    with pytest.raises(EpisodeError, match="render"):
        drawn().render()
    for lanes in ([3], [-1], [0.5], 1, "0", []):
        with pytest.raises(OptionError, match="render_lanes"):
            drawn(render_lanes=lanes)


def test_what_is_recorded_is_drawn_later_whatever_is_written_into_what_step_returned(monkeypatch):
    drawn = []
    draw = rendering.Renderer._draw
    monkeypatch.setattr(
        rendering.Renderer, "_draw", lambda self, surface: drawn.append(draw(self, surface))
    )
    env, untouched = begun(), begun()
    action = np.full(4, 0.5, np.float32)
    info = env.step(action)[4]
    untouched.step(action.copy())
    info["optimal_action"][:] = 0.0
    action[:] = 1.0
    assert drawn == []
    np.testing.assert_array_equal(env.render(), untouched.render())
    assert len(drawn) == 2


def test_the_numbers_shown_are_those_of_the_episode():
    env = begun("Default", k=4, horizon=10)
    earned, paid = 0.0, []
    for _ in range(10):
        _, reward, _, _, info = env.step(np.full(4, 0.5, np.float32))
        earned += info["step_reward"]
        paid.append(reward)
        renderer = env._renderer
        assert renderer._payout == pytest.approx(reward, abs=1e-9)
        assert renderer._earned - renderer._pending == pytest.approx(sum(paid), abs=1e-9)
    assert renderer._regrets[-1] == pytest.approx(10 - earned)
