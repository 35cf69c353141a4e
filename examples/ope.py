"""Off-policy evaluation, judged: fitted Q evaluation beside the exact return.

    pip install 'sme-registry[fast]'
    python examples/ope.py --env Default --nu 1 --seeds 0 1 2

A behaviour policy of quality ν acts 20,000 times. From these transitions alone, fitted Q evaluation
(FQE) estimates what other policies would earn; then the task says what they do earn.

FQE here is linear in random ReLU features φ of (observation, action), so that each of its rounds is
one solve with a matrix that is factorised once:

    w ← (Φᵀ Φ + λ I)⁻¹ Φᵀ (R + γ c φ(o', π(o')) w),   V(o) = φ(o, π(o)) w

c is 0 after a termination; a timeout is none. But what is judged is the return up to the horizon,
and the clock is in the observation: so at t = T c is 0, too.

At ν = 1 its estimates come in the right order and are drawn towards what the behaviour earns: the
further a policy's actions are from the data's, the more it knows of them by extrapolation alone.

Importance weighting is no choice here. α mixes two deterministic policies, so the behaviour's
actions lie on a line in each state, and any policy that leaves the line has no density ratio.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np

import sme_registry
from sme_registry.datasets import DatasetRecipe, Transitions, exact_return
from sme_registry.datasets.collect import collect
from sme_registry.evaluation import references

FEATURES, RIDGE, GAMMA, ROUNDS, STARTS = 400, 1e-3, 0.9, 60, 1000

Policy = Callable[[np.ndarray], np.ndarray]


class FittedQ:
    """Q of a policy, fitted to transitions.

    Args:
      transitions: the set.
      seed: of the random features.
    """

    def __init__(self, transitions: Transitions, seed: int) -> None:
        random = np.random.default_rng(seed)
        self._set = transitions
        width = transitions.observations.shape[1] + transitions.actions.shape[1]
        self._directions = random.normal(size=(width, FEATURES))
        self._offsets = random.normal(size=FEATURES)
        self._features = self._of(transitions.observations, transitions.actions)
        gram = self._features.T @ self._features
        self._inverse = np.linalg.inv(gram + RIDGE * len(transitions) * np.eye(len(gram)))
        self._continues = 1.0 - transitions.terminations
        self._continues[transitions.next_observations[:, -2] >= 1.0] = 0.0  # t = T

    def _of(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        inputs = 2.0 * np.concatenate([observations, actions], axis=1) - 1.0
        hidden = np.maximum(inputs @ self._directions + self._offsets, 0.0) / FEATURES**0.5
        return np.concatenate([hidden, np.ones((len(inputs), 1))], axis=1)

    def value(self, policy: Policy, observations: np.ndarray) -> np.ndarray:
        """The estimated discounted return of a policy from observations, `[M]`."""
        following = self._set.next_observations
        ahead = self._of(following, np.clip(policy(following), 0.0, 1.0))
        w = np.zeros(ahead.shape[1])
        for _ in range(ROUNDS):
            goal = self._set.rewards + GAMMA * self._continues * (ahead @ w)
            w = self._inverse @ (self._features.T @ goal)
        return self._of(observations, np.clip(policy(observations), 0.0, 1.0)) @ w


def policies(spec: sme_registry.SMESpec) -> dict[str, Policy]:
    """What is to be evaluated: from the optimum to a constant."""
    task, S = sme_registry.materialize(spec), spec.state_dim
    s = np.random.default_rng(0).random((20_000, S))
    fitted = references.fit(s, task.optimal_action(s))

    def optimal(observations: np.ndarray) -> np.ndarray:
        return task.optimal_action(observations[:, :S])

    def linear(observations: np.ndarray) -> np.ndarray:
        return (observations[:, :S] - 0.5) @ fitted.slope + fitted.intercept

    return {
        "optimal": optimal,
        "linear": linear,
        "half optimal, half ½": lambda o: 0.5 * optimal(o) + 0.25,
        "constant ½": lambda o: np.full((len(o), spec.action_dim), 0.5),
    }


def judge(spec: sme_registry.SMESpec, nu: float, seed: int, rows: int) -> dict[str, list[float]]:
    """For each policy: FQE's estimate, the exact value, and its 95 % interval over starts."""
    behaviour = {"kind": "mixture", "nu": nu}
    recipe = DatasetRecipe.from_dict(
        {"spec": spec, "behaviours": [behaviour], "transitions": rows, "seed": seed}, "data set"
    )
    fqe = FittedQ(collect(recipe, sme_registry.materialize(spec)), seed)
    starts = np.random.default_rng(seed + 1).random((STARTS, spec.state_dim))
    observations = np.concatenate([starts, np.zeros((STARTS, 2))], axis=1).astype(np.float32)
    found = {}
    for name, policy in policies(spec).items():
        truth = exact_return(policy, spec, states=starts, gamma=GAMMA).over_states()[1]
        estimate = float(fqe.value(policy, observations).mean())
        found[name] = [estimate, float(truth.mean), float(truth.low), float(truth.high)]
    return found


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="Default", help="an id, a path or a digest")
    parser.add_argument("--nu", type=float, default=1.0, help="of the behaviour, in [0, 1]")
    parser.add_argument("--transitions", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one data set for each")
    options = parser.parse_args()
    try:
        spec = sme_registry.load(options.env)
        for seed in options.seeds:
            found = judge(spec, options.nu, seed, options.transitions)
            print(f"\nseed {seed}: discounted return, γ = {GAMMA}, over {STARTS:,} starts")
            print(f"{'policy':>22}{'FQE':>9}{'exact':>9}{'95 % interval':>18}{'error':>9}")
            for name, (estimate, truth, low, high) in found.items():
                span = f"{low:.3f} to {high:.3f}"
                print(f"{name:>22}{estimate:9.3f}{truth:9.3f}{span:>18}{estimate - truth:+9.3f}")
    except sme_registry.SMEError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
