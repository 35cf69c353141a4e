"""Learners that know the optimum, and approach it as fast and as far as a test wants.

They make the results of studies in milliseconds: real cells, real curves, real evaluations.
"""

import numpy as np

from sme_registry import materialize


class Blend:
    """Plays a = (1 − e) a* + e w with w a wrong action, and an error e that falls as it learns.

    e = floor + (1 − floor) · 2^(−steps / half_life), floor the sum of what the task's axes cost it.
    Outside the cube it knows the nearest state inside only.
    """

    def __init__(self, env, seed, half_life, costs):
        self._env, self._task = env, materialize(env.sme_spec)
        rng = np.random.default_rng(seed)
        spec = env.sme_spec
        axes = {"k": np.log10(spec.k), "r_min": spec.r_min, "complexity": np.log10(spec.complexity)}
        floor = sum(cost * max(0.0, float(axes[axis])) for axis, cost in costs.items())
        self._floor = min(0.95, 0.05 + max(0.0, floor) + 0.1 * rng.beta(1.0, 4.0))
        self._half_life = half_life * rng.uniform(0.7, 1.4)
        self._wrong = rng.random(spec.action_dim)
        self._steps = 0

    def learn(self, total_timesteps):
        observation = self._env.reset()
        for _ in range(total_timesteps):
            self._steps += 1
            action, _ = self.predict(observation, deterministic=False)
            observation = self._env.step(action.astype(np.float32))[0]

    def predict(self, observation, *, deterministic):
        s = observation[:, : self._task.spec.state_dim].astype(np.float64)
        e = self._floor + (1.0 - self._floor) * 2.0 ** (-self._steps / self._half_life)
        a = (1.0 - e) * self._task.optimal_action(s.clip(0.0, 1.0)) + e * self._wrong
        return 2.0 * a - 1.0, None


def blend(env, *, seed, half_life, **costs):
    """What a plan's `uses` names."""
    return Blend(env, seed, half_life, costs)
