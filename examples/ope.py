"""Off-policy evaluation compared with the exact return: fitted Q evaluation (FQE) as an example.

    pip install '.[fast]'
    python examples/ope.py --env Default --nu 1 --seeds 0 1 2

A behaviour policy of quality ν collects 20,000 transitions. From these alone, FQE estimates the
return of other policies. `sme_registry.values` then computes what they really earn in the task.

This FQE is linear in random ReLU features φ of (observation, action), so each iteration is one
solve with a matrix that is inverted once:

    w ← (Φᵀ Φ + λ I)⁻¹ Φᵀ (R + γ c φ(o', π(o')) w),   V(o) = φ(o, π(o)) w

c is 0 after a termination and 1 after a timeout. The target is the return up to the horizon, and
observations include the time, so c is also 0 at t = T.

At ν = 1 the estimates have the right order but are biased towards the behaviour's return: the more
a policy's actions differ from the data, the more FQE has to extrapolate.

Importance weighting does not apply. α mixes two deterministic policies, so in each state the
behaviour's actions lie on a line, and a policy with other actions has no density ratio.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np

import sme_registry
from sme_registry.datasets import DatasetRecipe, Transitions, collect
from sme_registry.evaluation import reference_policy

FEATURES, RIDGE, GAMMA, ITERATIONS, STARTS = 400, 1e-3, 0.9, 60, 1000

Policy = Callable[[np.ndarray], np.ndarray]


class FittedQ:
    """Q of any policy, fitted to transitions.

    Args:
      transitions: the data set.
      seed: of the random features.
    """

    def __init__(self, transitions: Transitions, seed: int) -> None:
        random = np.random.default_rng(seed)
        self._transitions = transitions
        width = transitions.observations.shape[1] + transitions.actions.shape[1]
        self._directions = random.normal(size=(width, FEATURES))
        self._offsets = random.normal(size=FEATURES)
        self._data_features = self._features(transitions.observations, transitions.actions)
        gram = self._data_features.T @ self._data_features
        self._inverse = np.linalg.inv(gram + RIDGE * len(transitions) * np.eye(len(gram)))
        self._continues = 1.0 - transitions.terminations
        self._continues[transitions.next_observations[:, -2] >= 1.0] = 0.0  # t = T

    def _features(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        inputs = 2.0 * np.concatenate([observations, actions], axis=1) - 1.0
        hidden = np.maximum(inputs @ self._directions + self._offsets, 0.0) / FEATURES**0.5
        return np.concatenate([hidden, np.ones((len(inputs), 1))], axis=1)

    def value(self, policy: Policy, observations: np.ndarray) -> np.ndarray:
        """The estimated discounted return of a policy from observations, `[M]`."""
        data = self._transitions
        next_actions = np.clip(policy(data.next_observations), 0.0, 1.0)
        next_features = self._features(data.next_observations, next_actions)
        w = np.zeros(next_features.shape[1])
        for _ in range(ITERATIONS):
            targets = data.rewards + GAMMA * self._continues * (next_features @ w)
            w = self._inverse @ (self._data_features.T @ targets)
        return self._features(observations, np.clip(policy(observations), 0.0, 1.0)) @ w


def policies(spec: sme_registry.SMESpec) -> dict[str, Policy]:
    """The policies to evaluate, from the optimum to a constant."""
    optimal = reference_policy("optimal", spec)
    return {
        "optimal": optimal,
        "linear": reference_policy("linear", spec),
        "half optimal, half ½": lambda o: 0.5 * optimal(o) + 0.25,
        "constant ½": reference_policy("constant", spec),
    }


def compare(spec: sme_registry.SMESpec, nu: float, seed: int, rows: int) -> dict[str, list[float]]:
    """FQE's estimate, the exact value and its 95 % interval over starts, for each policy."""
    behaviour = {"kind": "mixture", "nu": nu}
    recipe = DatasetRecipe.from_dict(
        {"spec": spec, "behaviours": [behaviour], "transitions": rows, "seed": seed}, "data set"
    )
    fqe = FittedQ(collect(recipe, sme_registry.materialize(spec)), seed)
    starts = np.random.default_rng(seed + 1).random((STARTS, spec.state_dim))
    observations = np.concatenate([starts, np.zeros((STARTS, 2))], axis=1).astype(np.float32)
    values = {}
    for name, policy in policies(spec).items():
        exact = sme_registry.values(spec, policy, starts, gamma=GAMMA)
        arm = 1.96 * float(exact.std()) / STARTS**0.5
        estimate, mean = float(fqe.value(policy, observations).mean()), float(exact.mean())
        values[name] = [estimate, mean, mean - arm, mean + arm]
    return values


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="Default", help="an id, a path or a digest")
    parser.add_argument("--nu", type=float, default=1.0, help="of the behaviour, in [0, 1]")
    parser.add_argument("--transitions", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one data set for each")
    options = parser.parse_args()
    try:
        spec = sme_registry.load(options.env)
        for seed in options.seeds:
            values = compare(spec, options.nu, seed, options.transitions)
            print(f"\nseed {seed}: discounted return, γ = {GAMMA}, over {STARTS:,} starts")
            print(f"{'policy':>22}{'FQE':>9}{'exact':>9}{'95 % interval':>18}{'error':>9}")
            for name, (estimate, exact, low, high) in values.items():
                interval = f"{low:.3f} to {high:.3f}"
                print(
                    f"{name:>22}{estimate:9.3f}{exact:9.3f}{interval:>18}{estimate - exact:+9.3f}"
                )
    except sme_registry.SMEError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
