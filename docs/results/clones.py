"""Supervised clones of the optimal policy, with the networks of PPO, TD3 and SAC.

    python docs/results/clones.py --jobs 2         # writes the rows that are missing
    python docs/results/clones.py --visited        # those of clones in the states of PPO's training

What a clone cannot fit is approximation; what an agent of the same network lacks beside it is
learning. A clone is the capacity probe of `sme diagnose`: regression to the optimal action in as
many uniform states as a run has steps. Rewards do not concern it, so of the classes of `profile-v1`
those are fitted that change what is seen or done. One row a fit: N₀ in other uniform states.
With `--visited`, two classes are fitted in the states that an agent of PPO saw while it learned.
"""

from __future__ import annotations

import argparse
import functools
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sme_registry import SMESpec, materialize
from sme_registry.diagnosis.behaviour import probe_capacity
from sme_registry.evaluation import Perceptron
from sme_registry.profiles.document import plan_file

ROWS = Path(__file__).parent / "ablations-in-jax" / "clones.csv"
NETWORKS = {
    "PPO": ((64, 64), "tanh"),
    "TD3": ((400, 300), "relu"),
    "SAC": ((256, 256), "relu"),
}
FIELDS = "default", "state_dim", "action_dim", "complexity", "observation"  # of names of classes
VISITED = "default", "complexity-10"
KEY = ["class_name", "algorithm", "run", "states_of"]


def untrained(algorithm: str, spec: SMESpec) -> Perceptron:
    """The network of an agent's actor."""
    hidden, activation = NETWORKS[algorithm]
    widths = [spec.observation_dim, *hidden, spec.action_dim]
    layers = [
        (np.zeros(shape), np.zeros(shape[1]), name)
        for shape, name in zip(pairwise(widths), [activation] * 2 + ["identity"], strict=True)
    ]
    if algorithm == "PPO":
        return Perceptron(layers)
    return Perceptron(layers, low=np.zeros(spec.action_dim), high=np.ones(spec.action_dim))


@functools.cache
def visited(spec: SMESpec, run: int, states: int) -> np.ndarray:
    """The states `[N, S]` that PPO acts in while it learns, with Stable-Baselines3's defaults."""
    from stable_baselines3 import PPO

    from sme_registry.sb3 import SMEVecEnv

    seen: list[np.ndarray] = []

    def note(of: dict[str, Any], _: object) -> bool:
        seen.append(of["self"]._last_obs[:, : spec.state_dim].copy())
        return True  # go on

    agent = PPO("MlpPolicy", SMEVecEnv(spec), seed=run, device="cpu")
    agent.learn(states, callback=note)
    return np.concatenate(seen)


def fit(job: tuple[str, str, int, str, SMESpec, int]) -> dict[str, object]:
    """One row."""
    *key, spec, states = job
    _, algorithm, run, states_of = key
    probe = probe_capacity(
        untrained(algorithm, spec),
        materialize(spec),
        states,
        seed=run,
        visited=None if states_of == "uniform" else visited(spec, run, states),
    )
    row = dict(zip(KEY, key, strict=True))
    return row | {
        "states": probe.states,
        "gradient_steps": probe.gradient_steps,
        "wd_regret": round(probe.test_normalised_regret, 6),
        "in_sample": round(probe.train_normalised_regret, 6),
        "spec_digest": spec.digest,
    }


def main() -> None:
    """Fit what the file of rows lacks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--visited", action="store_true")
    options = parser.parse_args()
    plan = plan_file().plan
    names, states_of = (VISITED, "PPO") if options.visited else (FIELDS, "uniform")
    classes = [each for each in plan.classes if each.name.startswith(names)]
    rows = pd.read_csv(ROWS) if ROWS.exists() else pd.DataFrame(columns=KEY)
    known = set(map(tuple, rows[KEY].to_numpy().tolist()))
    missing = [
        (each.name, algorithm, run, states_of, spec, plan.steps)
        for each, algorithm in product(classes, NETWORKS)
        for run, spec in enumerate(each.instances)
        if (each.name, algorithm, run, states_of) not in known
    ]
    with ProcessPoolExecutor(options.jobs) as pool:
        for n, row in enumerate(pool.map(fit, missing), 1):
            rows = pd.concat([rows, pd.DataFrame([row])])
            rows.to_csv(ROWS, index=False)
            print(f"{n} of {len(missing)}: {row}")


if __name__ == "__main__":
    main()
