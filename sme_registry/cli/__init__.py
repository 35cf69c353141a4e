"""The command `sme`; the module of a command is imported when it is called.

Exit codes: 0 success; 1 a task refused by `certify`, or failed cells of a study; 2 invalid input;
130 interrupted.
"""

from __future__ import annotations

from typing import ClassVar

from sme_registry.io.terminal import CommandGroup, application


class _Commands(CommandGroup):
    modules: ClassVar = {
        "list": (f"{__name__}.show", "List tasks, streams, suites, protocols and studies."),
        "show": (f"{__name__}.show", "Show one of them: its fields, its digest and what follows."),
        "new": (f"{__name__}.task", "Write the file of a task of your own."),
        "suite": (f"{__name__}.task", "Write a suite of your own: classes of tasks."),
        "validate": (
            f"{__name__}.task",
            "Check files of tasks, suites, protocols and studies.",
        ),
        "certify": (f"{__name__}.task", "Draw a task and check that it is sound."),
        "train": (f"{__name__}.train", "Train an agent with its exact regret, and evaluate it."),
        "evaluate": (f"{__name__}.evaluate", "Evaluate a policy in and out of distribution."),
        "diagnose": (f"{__name__}.evaluate", "Show where a policy's regret occurs, and why."),
        "explore": (f"{__name__}.evaluate", "Write a page that shows the regret in any state."),
        "study": (f"{__name__}.study", "Compare algorithms on classes of tasks, over seeds."),
        "dataset": (f"{__name__}.data", "Make data sets for offline RL, of a chosen quality."),
        "offline": (f"{__name__}.data", "Train on a data set, never in the environment."),
        "demo": (f"{__name__}.train", "Train, evaluate and draw, in less than a minute."),
    }


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
    _Commands,
)


def main() -> None:
    app()


__all__ = ["app", "main"]
