"""Put an algorithm that is not in Stable-Baselines3 itself beside one that is, in a study's cells.

    pip install 'sme-registry[fast,train]' sb3-contrib
    python examples/sb3_contrib_cell.py --env Default --steps 8192 --seeds 0 1 2

An algorithm of a study is named by `uses`. A class of Stable-Baselines3's kind is named as it is,
here `sb3_contrib:TRPO`. Where it needs what JSON cannot say, name a function that makes the
learner, here `sb3_contrib_cell:wide_trpo` of this very file. In a plan, for `sme study run` in this
folder, the same reads

    {"name": "TRPO", "uses": "sb3_contrib:TRPO"}
    {"name": "TRPO (wide)", "uses": "sb3_contrib_cell:wide_trpo", "hyperparameters": {"width": 128}}

and `sme study new PLAN.json --from EDITED.json` makes a plan of a file that was edited so.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

from sme_registry import SMEError, load
from sme_registry.spec import EvaluationProtocol
from sme_registry.spec.study import Cell
from sme_registry.studies.engine.cell import run_cell

ALGORITHMS: dict[str, tuple[str, dict[str, Any]]] = {
    "PPO": ("PPO", {}),
    "TRPO": ("sb3_contrib:TRPO", {}),
    "TRPO (wide)": ("sb3_contrib_cell:wide_trpo", {"width": 128}),
    "linear": ("reference:linear", {}),
}


def wide_trpo(env: Any, *, seed: int, width: int) -> Any:
    """TRPO with wider layers, and an activation function that only Python can name.

    Args:
      env: the environment that the cell counts the steps of.
      seed: of the cell.
      width: of both hidden layers; from the cell's hyperparameters.
    """
    import torch
    from sb3_contrib import TRPO

    network = {"net_arch": [width, width], "activation_fn": torch.nn.ReLU}
    return TRPO("MlpPolicy", env, seed=seed, device="cpu", policy_kwargs=network)


def main() -> int:
    """Run every algorithm under every seed, and say what each of them reached."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="Default", help="an environment's name, file or digest")
    parser.add_argument("--steps", type=int, default=8192, help="of training, of each cell")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="a cell for each")
    asked = parser.parse_args()
    if asked.steps < 1:
        parser.error("--steps must be at least 1")
    try:
        spec = load(asked.env)
        print(f"{'algorithm':12}{'seed':>5}{'return':>9}{'regret':>9}{'WD r̃':>8}{'steps/s':>9}")
        for seed in asked.seeds:
            for name, (uses, hyperparameters) in ALGORITHMS.items():
                cell = Cell(
                    spec=spec,
                    uses=uses,
                    hyperparameters=hyperparameters,
                    action_range="symmetric",
                    seed=seed,
                    steps=asked.steps,
                    evaluations=4,
                    evaluation_episodes=20,
                    protocol=EvaluationProtocol(states_per_region=5000),
                )
                done = run_cell(cell)
                online = "" if done.online_regret is None else f"{done.online_regret:.3f}"
                rate = done.timing.steps_per_second
                print(
                    f"{name:12}{seed:5}{done.curve.episode_return[-1]:9.1f}{online:>9}"
                    f"{done.report.regions[0].similarity:8.3f}{f'{rate:,.0f}' if rate else '':>9}"
                )
    except SMEError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
