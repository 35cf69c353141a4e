"""Short training runs for these tests."""

import sys
from contextlib import contextmanager

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.training import train

TINY = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)
PROTOCOL = {"states_per_region": 50}
NARROW = {"policy_kwargs": {"net_arch": [8]}}


@contextmanager
def without_figures():
    """As without Matplotlib: figures take longer than training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        yield


def short(folder, **changes):
    settings = {
        "algorithm": "TD3",
        "steps": 150,
        "protocol": PROTOCOL,
        "progress": False,
    }
    return train(changes.pop("task", TINY), folder=folder, **{**settings, **changes})


def copy_files(source, target):
    target.mkdir()
    for path in source.iterdir():
        if path.is_file():
            (target / path.name).write_bytes(path.read_bytes())


class Still:
    """A learner that is no model of Stable-Baselines3."""

    def __init__(self, env, *, seed):
        self.env, self.shape = env, env.action_space.shape

    def learn(self, total_timesteps):
        """Learn nothing."""
        observation = self.env.reset()
        for _ in range(total_timesteps):
            observation = self.env.step(self.predict(observation, deterministic=True))[0]

    def predict(self, observation, *, deterministic):
        """The centre."""
        return np.zeros((len(observation), *self.shape))
