"""The random numbers of a batch: initial states, and what its steps draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from sme_registry.spec import SMESpec
from sme_registry.task.draw import normal_of_steps
from sme_registry.task.engine import draw
from sme_registry.task.task import (
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    Array,
    Indices,
    own_rows,
)

_AHEAD = 16  # states drawn at once for an environment
_NOISE_AHEAD = 64  # steps of a single environment whose noise is drawn at once
_MAX_NUMBERS = 2**19  # held in advance for all environments, 4 MiB
_KEY_SHIFT = np.uint64(12)  # keys of 52 bits, which a float64 holds exactly


class InitialStates:
    """The initial states of a batch: uniform in the cube, from each environment's own generator.

    Drawn sixteen at once, which costs little more than one and gives the same numbers.
    """

    def __init__(self, num_envs: int, state_dim: int) -> None:
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._ahead = max(1, min(_AHEAD, _MAX_NUMBERS // (num_envs * state_dim)))
        self._drawn = np.empty((num_envs, self._ahead, state_dim))
        self.count = np.zeros(num_envs, np.int64)  # of states drawn since the seed

    def seed(self, env: int, seed: int) -> None:
        self._generators[env] = seeding.np_random(seed)[0]
        self.count[env] = 0

    def generator(self, env: int) -> np.random.Generator:
        generator = self._generators[env]
        if generator is None:
            generator = self._generators[env] = seeding.np_random(None)[0]
        return generator

    def skip(self, env: int, count: int) -> None:
        """Go on, after `seed`, where so many states have been drawn."""
        generator = self.generator(env)
        self.count[env] = count
        blocks, in_block = divmod(count, self._ahead)
        drawn = self._drawn[env]
        cast("np.random.PCG64", generator.bit_generator).advance(blocks * drawn.size)
        if in_block:
            generator.random(out=drawn)

    def draw(self, envs: Indices) -> Array:
        """The next state of each of these environments, `[len(envs), state_dim]`."""
        position = self.count[envs] % self._ahead
        for env in envs[position == 0].tolist():
            self.generator(env).random(out=self._drawn[env])
        states: Array = self._drawn[envs, position]
        self.count[envs] += 1
        return states


class StepNumbers:
    """The random numbers that steps of `B` environments use, and the distractors that they move.

    They come from streams of their own, so that initial states are as without them.
    """

    def __init__(self, specs: Sequence[SMESpec], num_envs: int) -> None:
        self._m, n = specs[0].distractors, len(specs[0].agents)
        sigmas = [spec.noise for spec in specs if spec.noise is not None]
        rows = {"reward": slice(1, 1 + n), "transition": slice(1 + n, None)}
        self._noise = {
            f"noise/{name}": part
            for name, part in rows.items()
            if any(getattr(noise, name) for noise in sigmas)
        }
        self.own = np.zeros((own_rows(specs[0]), num_envs))  # see `task.task`
        self._drawn_ahead: tuple[Any, Array] = (None, np.empty(0))
        if self.are_drawn:
            words = np.random.SeedSequence().generate_state(num_envs, np.uint64)
            self.own[OWN_KEY] = words >> _KEY_SHIFT
            self.draw_noise()

    @property
    def distractors(self) -> Array:
        return self._of_distractors.T.copy()

    @property
    def noise(self) -> Array:
        return self.own[OWN_DISTRACTORS + self._m + 1 :].T.copy()

    @property
    def are_drawn(self) -> bool:
        """Whether steps or episodes draw any."""
        return bool(self._m or self._noise)

    @property
    def has_noise(self) -> bool:
        return bool(self._noise)

    @property
    def _of_distractors(self) -> Array:
        of_distractors: Array = self.own[OWN_DISTRACTORS:][: self._m]
        return of_distractors

    def seed(self, env: int, seed: int) -> None:
        """Restart the streams. They are none of those that the seed gives to initial states."""
        if self.are_drawn:
            (word,) = np.random.SeedSequence(seed, spawn_key=(1,)).generate_state(1, np.uint64)
            self.own[OWN_KEY, env] = word >> _KEY_SHIFT
            self.own[[OWN_DRAWN, OWN_DISTRACTORS + self._m], env] = 0.0
            self.draw_noise(slice(env, env + 1))

    def draw_noise(self, envs: slice = slice(None)) -> None:
        """Draw the noise of the next step: an action that is refused then changes nothing."""
        if not self._noise:
            return
        own = self.own[:, envs]
        key, of_noise = own[OWN_KEY].astype(np.uint64), own[OWN_DISTRACTORS + self._m :]
        of_noise[:] = (
            self._of_one(key, of_noise)
            if len(self.own[0]) == 1
            else (self._noise_of(key, of_noise[0]))
        )

    def _of_one(self, key: npt.NDArray[np.uint64], of_noise: Array) -> Array:
        """As `_noise_of` a single environment, whose steps are drawn some at once."""
        block, place = divmod(int(of_noise[0, 0]), _NOISE_AHEAD)
        drawn = key.item(), block
        if self._drawn_ahead[0] != drawn:
            steps = np.arange(block * _NOISE_AHEAD, (block + 1) * _NOISE_AHEAD, dtype=np.float64)
            self._drawn_ahead = drawn, self._noise_of(np.repeat(key, _NOISE_AHEAD), steps)
        return self._drawn_ahead[1][:, place : place + 1]

    def _noise_of(self, key: npt.NDArray[np.uint64], steps: Array) -> Array:
        """How many steps have drawn after these `[n]`, and the noise, `[1 + agents + S, n]`."""
        drawn = np.zeros((len(self.own) - OWN_DISTRACTORS - self._m, len(steps)))
        drawn[0] = steps + 1.0
        for name, rows in self._noise.items():
            drawn[rows] = normal_of_steps(key, name, steps, len(drawn[rows])).T
        return drawn

    def snapshot(self) -> dict[str, Array]:
        """Copies of what `seed` does not give."""
        drawn, noise = np.split(self.own[OWN_DRAWN:], [1 + self._m])
        return {"distractors": drawn.copy(), **({"noise": noise.copy()} if self._noise else {})}

    def restore(self, snapshot: Mapping[str, npt.NDArray[Any]]) -> None:
        parts = [snapshot[name] for name in ("distractors", "noise") if name in snapshot]
        self.own[OWN_DRAWN:][: sum(map(len, parts))] = np.concatenate(parts)

    def begin(self, envs: Indices, distractors: Array | None = None) -> None:
        """Distractors of environments that begin an episode, `[len(envs), m]`; None draws them."""
        if not self._m:
            return
        if distractors is None:
            own = self.own[:, envs]
            distractors = draw(own, self._m)
            self.own[OWN_DRAWN, envs] = own[OWN_DRAWN]
        self._of_distractors[:, envs] = distractors.T

    def beside(self, states: Array, envs: Indices) -> Array:
        """Some environments' states `[S, len(envs)]` and distractors, `[S + m, len(envs)]`."""
        if not self._m:
            return states
        return np.concatenate([states, self._of_distractors[:, envs]])
