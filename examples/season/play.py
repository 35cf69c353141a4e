"""Players of sealed seasons that know nothing of the family: PPO, SAC and a table.

    sme-leaderboard ticket URL winter --method SAC --submitter ME --out sac.json
    python examples/season/play.py sac URL sac.json --out runs/sac
    sme-leaderboard answer URL sac.json 'runs/sac/{name}.zip'

    python examples/season/play.py table autumn --out runs/table
    sme-leaderboard enter URL autumn 'runs/table/{name}.npy' --method Table --submitter ME

`ppo` and `sac` spend the budget of each instance of a ticket. If one is stopped or killed, start it
again with the same arguments: it goes on with the last model that it saved and the steps that are
left. `table` answers with the mean of the eight nearest of the best actions of a data set.
`sme train --data` trains BC and IQL.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry import seasons
from sme_registry.datasets import SealedDataset
from sme_registry.errors import BudgetSpentError, SMEError
from sme_registry.io import read_json

SAVE_EVERY = 500  # steps, which are all that a killed player forgets
BEST, NEIGHBOURS = 4, 8  # of the table: a quarter of the rows, by reward
LANES = {"ppo": 8, "sac": 4}
SETTINGS: dict[str, dict[str, Any]] = {
    "ppo": {"n_steps": 50, "batch_size": 50},  # 400 steps a rollout divide the budget
    "sac": {  # two gradient steps for four steps
        "gradient_steps": 2,
        "batch_size": 128,
        "learning_rate": 1e-3,
        "buffer_size": 20_000,
        "policy_kwargs": {"net_arch": [128, 128]},
    },
}


def learn(algorithm: str, url: str, ticket: Path, number: int, file: Path) -> None:
    """Learn one instance with Stable-Baselines3 until its budget is spent.

    Args:
      algorithm: "ppo" or "sac".
      url, ticket, number: of the instance.
      file: of the model, a .zip; its replay buffer lies beside it.
    """
    import stable_baselines3
    from stable_baselines3.common.callbacks import BaseCallback

    from sme_registry.seasons.sb3 import SealedVecEnv

    env = SealedVecEnv(url, ticket, number, num_envs=LANES[algorithm])
    kind = getattr(stable_baselines3, algorithm.upper())
    buffer = file.with_suffix(".buffer.pkl")
    if file.exists():
        model = kind.load(file, env=env, device="cpu")
        if buffer.exists():
            model.load_replay_buffer(buffer)
    else:
        model = kind("MlpPolicy", env, device="cpu", seed=number, **SETTINGS[algorithm])

    def save() -> None:
        if hasattr(model, "replay_buffer"):
            replace(buffer, model.save_replay_buffer)
        replace(file, model.save)

    class Save(BaseCallback):
        saved = model.num_timesteps

        def _on_step(self) -> bool:
            if self.num_timesteps - self.saved >= SAVE_EVERY:
                save()
                self.saved = self.num_timesteps
            return True

    env.reset()  # asks the server how much of the budget is left
    with contextlib.suppress(BudgetSpentError):
        model.learn(env.instance.steps_left, Save(), reset_num_timesteps=False)
    save()
    env.close()


def replace(file: Path, write: Any) -> None:
    """Write a file beside its place, then put it there: a killed player leaves the old one."""
    new = file.with_name(f"new.{file.name}")
    write(new)
    os.replace(new, file)


def answer_from_table(published: Path, name: str, season: str, file: Path) -> None:
    """Write the actions of a table of states in an instance's challenge states.

    Args:
      published: the season's folder.
      name: of the instance, such as deep-0.
      season: its id.
      file: of the answers, a .npy.
    """
    from scipy.spatial import cKDTree

    data = SealedDataset.read(published / f"datasets/sealed/{season}/{name}-v0")
    best = np.argsort(-data.rewards)[: len(data) // BEST]
    states = np.load(published / f"challenges/{name}.npy")[:, :-2]
    _, nearest = cKDTree(data.observations[best, :-2]).query(states, range(1, NEIGHBOURS + 1))
    np.save(file, data.actions[best][nearest].mean(axis=1))


def main() -> int:
    """Play all instances of a ticket, or of a season offline."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    players = parser.add_subparsers(dest="player", required=True)
    for player in (*LANES, "table"):
        each = players.add_parser(player)
        if player == "table":
            each.add_argument("published", type=Path, help="the folder of the organiser")
        else:
            each.add_argument("url")
            each.add_argument("ticket", type=Path)
            each.add_argument("--instance", "-i", action="append", help="only this; repeatable")
        each.add_argument("--out", type=Path, required=True, help="folder of models or answers")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    try:
        if arguments.player == "table":
            season = read_json(arguments.published / "season.json")
            for member in season["classes"]:
                for number in range(member["instances"]):
                    name = f"{member['name']}-{number}"
                    file = arguments.out / f"{name}.npy"
                    answer_from_table(arguments.published, name, season["id"], file)
        else:
            play(arguments)
    except SMEError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def play(arguments: argparse.Namespace) -> None:
    """Play the instances of a ticket."""
    import torch

    torch.set_num_threads(1)  # networks this small are slower on several threads
    for number, place in enumerate(seasons.Ticket.read(arguments.ticket).places):
        if place.name not in (arguments.instance or [place.name]):
            continue
        begun = time.process_time()
        file = arguments.out / f"{place.name}.zip"
        learn(arguments.player, arguments.url, arguments.ticket, number, file)
        print(f"{place.name}: {time.process_time() - begun:.0f} s of processor time", flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
