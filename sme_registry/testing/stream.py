"""Checks of a stream's environment and of its batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.envs import SMEStreamEnv, SMEStreamVectorEnv
from sme_registry.spec import StreamLike, StreamSpec
from sme_registry.task import Task, load, materialize_stream, observe, step
from sme_registry.testing.comparing import TOLERANCE, expect_equal, expect_near, expect_same
from sme_registry.testing.episodes import INFO_KEYS, LONGEST_LIFE, Make, has_ended, next_action
from sme_registry.testing.single import (
    check_determinism,
    check_env_spec,
    check_gymnasium,
    check_pickling,
    check_vector,
)


def check_stream(
    stream: StreamLike,
    *,
    single: Make = SMEStreamEnv,
    vector: Make = SMEStreamVectorEnv,
    seed: int = 0,
) -> None:
    """Run every check of a stream. Lives are played up to 1,000 steps: check a short stream.

    Args:
      stream: an id, a path, a digest, a stream or its fields.
      single: creates the environment as `SMEStreamEnv` does: `single(stream, action_range=…)`.
      vector: creates the batch as `SMEStreamVectorEnv` does: `vector(stream, num_envs, …)`.
      seed: of the episodes and the actions.

    Raises:
      ConformanceError: the first check that fails.

    Examples:
      >>> from sme_registry.testing import check_stream
      >>> task = sme_registry.SMESpec(horizon=5)
      >>> phases = [dict(spec=task, steps=10), dict(spec=task.derive(k=5), steps=10)]
      >>> check_stream(sme_registry.StreamSpec(phases=phases))
    """
    check_gymnasium(stream, single=single)
    check_stream_definition(stream, single=single, seed=seed)
    check_determinism(stream, single=single, seed=seed)
    check_pickling(stream, single=single, vector=vector, seed=seed)
    check_vector(stream, single=single, vector=vector, seed=seed)
    check_env_spec(stream)


def check_stream_definition(
    stream: StreamLike, *, single: Make = SMEStreamEnv, seed: int = 0
) -> None:
    """Each step of a life and of a second one equals `sme_registry.task.step` of the piece's task.

    Pieces change when METHOD, section 7, says. States, ends, phases and lifetimes are compared
    exactly, optimal actions and rewards to 1e-12.

    Examples:
      >>> from sme_registry.testing import check_stream_definition
      >>> task = sme_registry.SMESpec(horizon=5)
      >>> phases = [dict(spec=task, steps=10), dict(spec=task.derive(k=5), steps=10)]
      >>> check_stream_definition(sme_registry.StreamSpec(phases=phases))
    """
    stream = load(stream, StreamSpec)
    tasks, env, rng = materialize_stream(stream), single(stream), np.random.default_rng(seed)
    for life in range(2):
        lifetime, first_seed = 0, seed + life
        while lifetime < min(stream.steps + stream.horizon, LONGEST_LIFE):
            piece, episode_seed = stream.piece_at(lifetime), None if lifetime else first_seed
            observation, info = env.reset(seed=episode_seed)
            _check_reset(stream, tasks[piece], piece, env.state, observation, info, lifetime)
            s, r_cum, t, ended = env.state[None], np.zeros((1, 1)), 0, False
            while not ended:
                action = next_action(env, rng)
                done = step(tasks[piece], s, np.array([t]), r_cum, action.astype(np.float64)[None])
                returned = env.step(action)
                observation, reward, terminated, truncated, info = returned
                lifetime, t, ended = lifetime + 1, t + 1, has_ended(returned)
                expect_equal("info's keys", set(info), INFO_KEYS | {"phase", "lifetime"})
                _check_life(stream, piece, lifetime, info)
                expect_near("optimal_action", info["optimal_action"], done.optimal_action[0])
                expect_near("regret", info["regret"], 1.0 - done.step_reward[0, 0])
                tolerance = stream.horizon * TOLERANCE
                expect_near("the reward", reward, done.reward[0, 0], tolerance)
                expect_equal("terminated", terminated, bool(done.terminated[0]))
                expect_equal("truncated", truncated, bool(done.truncated[0]))
                if stream.switch == "step":
                    piece = stream.piece_at(lifetime)
                s, r_cum = done.state, np.array([[info["accumulated_reward"]]])
                expect_near("r_cum", r_cum, done.accumulated_reward, tolerance)
                expect_equal("the next state", env.state, s[0])
                expect_equal("the task in force", env.sme_spec, tasks[piece].spec)
                expected = _observation(stream, tasks[piece], piece, s, t, r_cum)
                expect_equal("the observation", observation, expected)


def _check_reset(
    stream: StreamSpec,
    task: Task,
    piece: int,
    state: npt.NDArray[np.float64],
    observation: Any,
    info: dict[str, Any],
    lifetime: int,
) -> None:
    expect_equal("info's keys at reset", set(info), INFO_KEYS | {"phase", "lifetime"})
    _check_life(stream, piece, lifetime, info)
    expected = _observation(stream, task, piece, state[None], 0, np.zeros((1, 1)))
    expect_equal("the first observation", observation, expected)


def _check_life(stream: StreamSpec, piece: int, lifetime: int, info: dict[str, Any]) -> None:
    expect_same("phase", info["phase"], np.int64(stream.pieces[piece].phase))
    expect_same("lifetime", info["lifetime"], np.int64(lifetime))


def _observation(
    stream: StreamSpec, task: Task, piece: int, s: Any, t: int, r_cum: Any
) -> npt.NDArray[np.float32]:
    """(s, t/T, r_cum/k), and the one-hot of the piece's phase where the stream shows it."""
    observation = observe(task.spec, s, np.array([t]), r_cum)[0]
    one_hot = np.eye(len(stream.phases), dtype=np.float32)[stream.pieces[piece].phase]
    return np.concatenate([observation, one_hot]) if stream.observes_phase else observation
