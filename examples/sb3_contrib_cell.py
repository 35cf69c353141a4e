"""Compare algorithms from other packages with Stable-Baselines3's, as cells of a study.

    pip install '.[fast,train]' sb3-contrib
    python examples/sb3_contrib_cell.py --env Default --steps 8192 --seeds 0 1 2

The field `uses` names the algorithm of a cell. It can be a class with the interface of
Stable-Baselines3, such as `sb3_contrib:TRPO`, or a function that creates the learner, such as
`sb3_contrib_cell:wide_trpo` in this file, for settings that JSON cannot express. In a study plan,
for `sme study run` in this folder, write

    {"name": "TRPO", "uses": "sb3_contrib:TRPO"}
    {"name": "TRPO (wide)", "uses": "sb3_contrib_cell:wide_trpo", "hyperparameters": {"width": 128}}

After editing a plan, run `sme study new PLAN.json --from EDITED.json`.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

from sme_registry import SMEError, load
from sme_registry.spec import EvaluationProtocol
from sme_registry.spec.study import Cell
from sme_registry.studies import run_cell

ALGORITHMS: dict[str, tuple[str, dict[str, Any]]] = {
    "PPO": ("PPO", {}),
    "TRPO": ("sb3_contrib:TRPO", {}),
    "TRPO (wide)": ("sb3_contrib_cell:wide_trpo", {"width": 128}),
    "linear": ("reference:linear", {}),
}


def wide_trpo(env: Any, *, seed: int, width: int) -> Any:
    """TRPO with wider layers and ReLU, which is a Python class that JSON cannot express.

    Args:
      env: the environment, whose steps the cell counts.
      seed: of the cell.
      width: of both hidden layers, from the cell's hyperparameters.
    """
    import torch
    from sb3_contrib import TRPO

    network = {"net_arch": [width, width], "activation_fn": torch.nn.ReLU}
    return TRPO("MlpPolicy", env, seed=seed, device="cpu", policy_kwargs=network)


def main() -> int:
    """Run all algorithms with all seeds, and print their results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="Default", help="a task: an id, a path or a digest")
    parser.add_argument("--steps", type=int, default=8192, help="training steps of each cell")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one cell for each")
    arguments = parser.parse_args()
    if arguments.steps < 1:
        parser.error("--steps must be at least 1")
    try:
        spec = load(arguments.env)
        print(f"{'algorithm':12}{'seed':>5}{'return':>9}{'regret':>9}{'WD r̃':>8}{'steps/s':>9}")
        for seed in arguments.seeds:
            for name, (uses, hyperparameters) in ALGORITHMS.items():
                cell = Cell(
                    spec=spec,
                    uses=uses,
                    hyperparameters=hyperparameters,
                    action_range="symmetric",
                    seed=seed,
                    steps=arguments.steps,
                    evaluations=4,
                    evaluation_episodes=20,
                    protocol=EvaluationProtocol(states_per_region=5000),
                )
                result = run_cell(cell)
                online = "" if result.online_regret is None else f"{result.online_regret:.3f}"
                rate = result.timing.steps_per_second
                print(
                    f"{name:12}{seed:5}{result.curve.episode_return[-1]:9.1f}{online:>9}"
                    f"{result.report.regions[0].similarity:8.3f}{f'{rate:,.0f}' if rate else '':>9}"
                )
    except SMEError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
