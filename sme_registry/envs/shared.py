"""Observations and actions of one policy that acts for every agent of a team.

Agents of a team may observe and own different numbers of channels; a shared policy needs one width
for all. It is called for each agent in turn, with that agent's *shared observation*

    (s with the channels that the agent does not observe set to 0, t/T, its r_cum/k, one-hot of i)

`[B, S + 2 + n]`, so it observes no more of the state than the agent does, and which agent it is.
It returns `[B, max a_i]`, of which the agent's first a_i are used. `B` batch, `S` state_dim, `n`
agents, a_i the channels that agent i owns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sme_registry.envs.types import Observation
from sme_registry.task import Task


def shared_observation_dim(task: Task) -> int:
    """Entries of a shared observation, S + 2 + n."""
    return task.spec.state_dim + 2 + len(task.observed)


def shared_action_dim(task: Task) -> int:
    """Entries of a shared policy's action: as many as the agent with most channels owns."""
    return int(max(channels.stop - channels.start for channels in task.owned))


def shared_observation(task: Task, joint: Observation) -> Observation:
    """Each agent's shared observation, `[B, n, S + 2 + n]` float32, a fresh array.

    `joint` is `[B, S + 1 + n]` float32: s, t/T, and each agent's r_cum/k.
    """
    S, n = task.spec.state_dim, len(task.observed)
    shared = np.empty((len(joint), n, shared_observation_dim(task)), np.float32)
    single = joint[:, : S + 2].copy()
    for agent, observed in enumerate(task.observed):
        single[:, S + 1] = joint[:, S + 1 + agent]
        shared[:, agent] = shared_observation_of(agent, n, observed, single)
    return shared


def shared_observation_of(
    agent: int, agents: int, observed: Sequence[int], single: Observation
) -> Observation:
    """The shared observation of one agent of `agents`, `[B, S + 2 + n]` float32, a fresh array.

    `single` is `[B, S + 2]` float32: s, t/T, and this agent's r_cum/k.
    """
    width = single.shape[1]
    visible = [*observed, width - 2, width - 1]
    shared = np.zeros((len(single), width + agents), np.float32)
    shared[:, visible] = single[:, visible]
    shared[:, width + agent] = 1.0
    return shared
