"""The command `sme`; the module of a command is imported when it is called.

Exit codes: 0 success; 1 a task refused by `check`, or failed cells of a study; 2 invalid input;
130 interrupted.
"""

from __future__ import annotations

from typing import ClassVar

from sme_registry.io.terminal import CommandGroup, application


class _Commands(CommandGroup):
    modules: ClassVar = {
        "list": (f"{__name__}.show", "List tasks, streams, suites, protocols and studies."),
        "show": (f"{__name__}.show", "Show one of them: its fields, its digest and what follows."),
        "new": (f"{__name__}.task", "Write the file of a task or a suite of your own."),
        "check": (f"{__name__}.task", "Check files, and that the drawn tasks are sound."),
        "train": (f"{__name__}.train", "Train an agent with its exact regret, and evaluate it."),
        "evaluate": (f"{__name__}.evaluate", "Evaluate a policy in and out of distribution."),
        "diagnose": (f"{__name__}.evaluate", "Show where a policy's regret occurs, and why."),
        "profile": (f"{__name__}.profile", "Show where an algorithm breaks, beside known ones."),
        "study": (f"{__name__}.study", "Compare algorithms on classes of tasks, over seeds."),
        "data": (f"{__name__}.data", "Make data sets for offline RL, of a chosen quality."),
        "demo": (f"{__name__}.train", "Train, evaluate and draw, in less than a minute."),
    }
    replaced: ClassVar = {
        "suite": "is `sme new` now: sme new mine.json -t Default --instances 5.",
        "validate": "is `sme check` now, which also checks the draw: sme check mine.json.",
        "certify": "is `sme check` now, which also checks the file: sme check mine.json.",
        "dataset": "is `sme data` now: sme data make Default --nu 0.5.",
        "explore": "is `sme diagnose --explore` now: sme diagnose runs/demo --explore.",
        "offline": "is `sme train --data` now: sme train --data DATASET -a iql.",
    }


app = application(
    "sme",
    """Synthetic Monitoring Environments: control tasks whose optimal policy is known exactly.

    To start:

      sme show Default
      sme demo

    Your own task, and an agent on it; with --agents jax it is faster:

      sme new mine.json --complexity 10 --seed 3
      sme check mine.json
      sme train mine.json -a PPO
    """,
    _Commands,
)


def main() -> None:
    app()


__all__ = ["app", "main"]
