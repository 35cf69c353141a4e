"""Weights of a lane in networks of a wider observation or action: exact padding, and its removal.

A padded observation is `[s padded to S_pad, d, t/T, r_cum/k, phase]`, also where the agent sees a
mixture of s and the distractors d; a padded action is `[a padded to A_pad]`.
Weights of what is padded are 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.jax.networks import HostWeights

Array = npt.NDArray[Any]
InitialWeights = Callable[[np.random.Generator, int, int], HostWeights]
"""From random numbers, the width of an observation and that of an action, to initial weights."""


class Dimensions(NamedTuple):
    """S, A, P (0 without `observes_phase`) and m, of a task or of what it is padded to."""

    state_dim: int
    action_dim: int
    phases: int = 0
    distractors: int = 0

    @property
    def observation_dim(self) -> int:
        return self.state_dim + self.distractors + 2 + self.phases


class Padding:
    """Pads the weights of networks to the widths of a program, and removes the padding.

    Which axes are observations and actions follows from the shapes of initial weights at other
    widths, so no list of names has to agree with the networks. An axis that is both is an
    observation followed by an action, as a critic's input.
    """

    def __init__(self, initial_weights: InitialWeights, full: Dimensions) -> None:
        self._full = full
        rng = np.random.default_rng(0)
        base, wider, longer = (
            {name: weight.shape for name, weight in initial_weights(rng, *dims).items()}
            for dims in ((3, 1), (4, 1), (3, 2))
        )
        self._axes = {
            name: [(w > b, a > b) for b, w, a in zip(shape, wider[name], longer[name], strict=True)]
            for name, shape in base.items()
        }

    def add(self, weights: Mapping[str, Array], own: Dimensions) -> HostWeights:
        """The weights of networks of these widths, padded with 0."""
        padded = {}
        for name, weight in weights.items():
            kept = self._kept(name, weight.shape, own)
            padded[name] = np.zeros([extent for _, extent in kept], weight.dtype)
            padded[name][np.ix_(*(indices for indices, _ in kept))] = weight
        return padded

    def remove(self, weights: Mapping[str, Array], own: Dimensions) -> HostWeights:
        """The weights without their padding."""
        return {
            name: np.array(
                weight[np.ix_(*(indices for indices, _ in self._kept(name, weight.shape, own)))]
            )
            for name, weight in weights.items()
        }

    def _kept(self, name: str, shape: tuple[int, ...], own: Dimensions) -> list[tuple[Array, int]]:
        """Of each axis, the indices that are no padding, and its padded extent."""
        S, full = own.state_dim, self._full
        observation = np.r_[:S, full.state_dim : full.observation_dim]
        action = np.arange(own.action_dim)
        either = {
            (True, False): (observation, full.observation_dim),
            (False, True): (action, full.action_dim),
            (True, True): (
                np.r_[observation, full.observation_dim + action],
                full.observation_dim + full.action_dim,
            ),
        }
        return [
            either.get(axis, (np.arange(extent), extent))
            for axis, extent in zip(self._axes[name], shape, strict=True)
        ]
