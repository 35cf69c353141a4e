"""The command `sme` and its subcommands.

Exit codes: 0 success; 1 a task refused by `certify`, or failed cells of a study; 2 invalid input;
130 interrupted.
"""

from __future__ import annotations

from sme_registry.cli import study
from sme_registry.cli.data import dataset, offline
from sme_registry.cli.policy import diagnose, evaluate, explore
from sme_registry.cli.show import list_, show
from sme_registry.cli.task import certify, new, suite, validate
from sme_registry.cli.train import demo, train
from sme_registry.io.terminal import application

app = application(
    "sme",
    """Synthetic Monitoring Environments: control tasks whose optimal policy is known exactly.

    To start:

      sme list
      sme show Default
      sme demo

    Your own task:

      sme new mine.json --complexity 10 --seed 3

    An agent of Stable-Baselines3, and the same in JAX, which is faster:

      sme train mine.json -a PPO
      sme train mine.json -a PPO --agents jax
    """,
)
app.command("list")(list_)
for _command in (show, new, validate, certify, evaluate, train, diagnose, explore, demo):
    app.command()(_command)
app.add_typer(suite, name="suite")
app.add_typer(study.app, name="study")
app.add_typer(dataset, name="dataset")
app.add_typer(offline, name="offline")


def main() -> None:
    app()


__all__ = ["app", "main"]
