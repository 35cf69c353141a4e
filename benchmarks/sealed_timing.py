"""Whether the time of a sealed step tells anything of the hidden state or the optimum.

    python -m benchmarks.sealed_timing [steps]

A step of one lane is timed inside the server's process, without the network, whose noise hides
more. Its time is correlated with what an entrant would like to know: the regret of the step, the
mean of the optimal action, and the mean of the state. Steps that end an episode are left out, as
the answer tells. Correlations are of ranks, since times have outliers, and come with the interval
that independent quantities stay in.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import sys
import time

import numpy as np
from scipy.stats import spearmanr

from leaderboard.seasons.journal import Play
from sme_registry import SMESpec, materialize
from sme_registry.envs import SMEVectorEnv
from sme_registry.seasons.transcript import Chain
from sme_registry.seasons.wire import StepFormat

SPEC = SMESpec(complexity=5, seed=20)
START = (SPEC, 1, Chain(request="sha256:" + "0" * 64, ticket=1, instance=0))


def main(steps: int = 100_000) -> None:
    random = np.random.default_rng(2)
    env, task = SMEVectorEnv(SPEC, 1, autoreset_mode="SameStep"), materialize(SPEC)
    observation = env.reset(seed=START[1])[0]
    shape = steps, SPEC.action_dim
    # From the optimum to any action, so that the regret takes all values.
    noise = random.random((steps, 1)) * random.uniform(-1.0, 1.0, shape)
    states, optimal = np.empty((steps, SPEC.state_dim)), np.empty(shape)
    regret, ended = np.empty(steps), np.empty(steps, bool)
    actions = np.empty(shape, np.float32)
    for i in range(steps):
        states[i] = observation[0, : SPEC.state_dim]
        optimal[i] = task.optimal_action(states[i])
        actions[i] = np.clip(optimal[i] + noise[i], 0.0, 1.0)
        observation, _, terminated, truncated, info = env.step(actions[i : i + 1])
        regret[i], ended[i] = info["regret"][0], terminated[0] or truncated[0]
    seconds = timed(actions)[~ended]
    low, middle, high = np.quantile(seconds, [0.05, 0.5, 0.95]) * 1e6
    print(f"{len(seconds):,} steps: {middle:.1f} µs, 5 to 95 %: {low:.1f} to {high:.1f}")
    quantities = {
        "regret": regret,
        "mean optimal action": optimal.mean(axis=1),
        "mean state": states.mean(axis=1),
    }
    for name, every in quantities.items():
        values = every[~ended]
        r = spearmanr(seconds, values).statistic
        ends = [np.median(seconds[values <= np.quantile(values, 0.1)])]
        ends += [np.median(seconds[values >= np.quantile(values, 0.9)])]
        print(
            f"{name:20} rank correlation {r:+.4f} ± {1.96 / np.sqrt(len(seconds)):.4f}; "
            f"highest tenth {(ends[1] - ends[0]) * 1e9:+.0f} ns after the lowest"
        )


def timed(actions: np.ndarray) -> np.ndarray:
    """Seconds of each step, as the server takes it, of actions `[n, A]`."""
    form = StepFormat(1, SPEC.state_dim, SPEC.action_dim)
    play, seconds = Play(*START, 1, 10**8), np.empty(len(actions))
    for i, each in enumerate(actions):
        body = form.pack(i + 1, each[None])
        begun = time.perf_counter()
        play.take(body)
        seconds[i] = time.perf_counter() - begun
    return seconds


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
