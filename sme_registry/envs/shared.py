"""What one policy that acts for every agent of a team is shown, and what it answers.

Agents of a team may observe and own different numbers of channels; a shared policy needs one width
for all. It is asked for each agent in turn, with that agent's *shared observation*

    (s with the channels that the agent does not observe set to 0, t/T, its r_cum/k, one-hot of i)

`[B, S + 2 + n]`, so it sees no more of the state than the agent does and knows whom it acts for.
It answers `[B, max a_i]`, of which the agent's first a_i are used. `B` batch, `S` state_dim, `n`
agents, a_i the channels that agent i owns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sme_registry.task import Task

Observation = npt.NDArray[np.float32]


def shared_observation_dim(task: Task) -> int:
    """Entries of a shared observation, S + 2 + n."""
    return task.spec.state_dim + 2 + len(task.observed)


def shared_action_dim(task: Task) -> int:
    """Entries of a shared policy's action: of the agent that owns most."""
    return int(max(own.stop - own.start for own in task.owned))


def shared_observation(task: Task, joint: Observation) -> Observation:
    """What a shared policy is shown for each agent.

    Args:
      task: the task; one without a team is a team of one.
      joint: `[B, S + 1 + n]` float32 joint observations: s, t/T, and each agent's r_cum/k.

    Returns:
      `[B, n, S + 2 + n]` float32, a fresh array.
    """
    shown = np.empty((len(joint), len(task.observed), shared_observation_dim(task)), np.float32)
    for agent, observed in enumerate(task.observed):
        shown[:, agent] = shared_observation_of(agent, observed, task.spec.state_dim, joint)
    return shown


def shared_observation_of(
    agent: int, observed: Sequence[int], state_dim: int, joint: Observation
) -> Observation:
    """What a shared policy is shown for one agent.

    Args:
      agent: which, in [0, n).
      observed: the state channels that it observes.
      state_dim: S.
      joint: `[B, S + 1 + n]` as in `shared_observation`.

    Returns:
      `[B, S + 2 + n]` float32, a fresh array.
    """
    S, channels = state_dim, list(observed)
    shown = np.zeros((len(joint), joint.shape[1] + 1), np.float32)
    shown[:, channels] = joint[:, channels]
    shown[:, S] = joint[:, S]
    shown[:, S + 1] = joint[:, S + 1 + agent]
    shown[:, S + 2 + agent] = 1.0
    return shown
