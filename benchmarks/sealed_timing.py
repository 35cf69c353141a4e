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
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from leaderboard.seasons.instance import SteppedInstance
from leaderboard.seasons.season import SeasonClass
from leaderboard.seasons.stepping import Lanes, Start
from sme_registry import EvaluationProtocol, SMESpec, materialize
from sme_registry.seasons.wire import StepFormat

SPEC = SMESpec(complexity=5, seed=20)
START = Start(SPEC, 1)


def main(steps: int = 100_000) -> None:
    random = np.random.default_rng(2)
    lanes, task = Lanes(START, 1), materialize(SPEC)
    shape = steps, SPEC.action_dim
    # From the optimum to any action, so that the regret takes all values.
    noise = random.random((steps, 1)) * random.uniform(-1.0, 1.0, shape)
    states, optimal = np.empty((steps, SPEC.state_dim)), np.empty(shape)
    regret, ended = np.empty(steps), np.empty(steps, bool)
    actions = np.empty(shape, np.float32)
    for i in range(steps):
        states[i] = lanes.observation[0, : SPEC.state_dim]
        optimal[i] = task.optimal_action(states[i])
        actions[i] = np.clip(optimal[i] + noise[i], 0.0, 1.0)
        done, measured = lanes.step_with_regret(actions[i : i + 1])
        regret[i], ended[i] = measured.taken, done.terminated[0] or done.truncated[0]
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
    plain = {name: value for name, value in SPEC.to_dict().items() if name != "seed"}
    member = SeasonClass(name="deep", setting=plain, instances=1, budget=10**8)
    wire = StepFormat(1, SPEC.state_dim, SPEC.action_dim)
    bodies = [wire.pack(i + 1, each[None]) for i, each in enumerate(actions)]
    seconds = np.empty(len(actions))
    with tempfile.TemporaryDirectory() as folder:
        instance = SteppedInstance(Path(folder), 0, member, EvaluationProtocol(), lambda: START)
        instance.start(1)
        for i, body in enumerate(bodies):
            begun = time.perf_counter()
            instance.step(body)
            seconds[i] = time.perf_counter() - begun
    return seconds


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
