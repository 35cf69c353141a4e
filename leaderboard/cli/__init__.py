"""The command `sme-leaderboard`; the module of a command is imported when it is called.

Exit codes: 0 success, 1 rejected with a stable code, 2 invalid usage, 3 tampering detected, 130
interrupted.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import ClassVar

from leaderboard.errors import Rejection, TamperedError
from sme_registry.errors import SealedError
from sme_registry.io.terminal import CommandGroup, application

if find_spec("leaderboard.seasons") is not None:
    from leaderboard.seasons import COMMANDS
else:
    COMMANDS = {}

_SUBMIT, _RESULTS = f"{__name__}.submit", f"{__name__}.results"
_HOST = f"{__name__}.admin"

_PANELS = {
    "To submit": {
        "submit": (_SUBMIT, "Submit trained runs to a board."),
        "withdraw": (_SUBMIT, "Withdraw your submission; its page stays and says so."),
    },
    "To read": {
        "rank": (_RESULTS, "Rank the entries by a metric."),
        "show": (_RESULTS, "Show one submission: its method, runs and scores."),
        "fetch": (_RESULTS, "Copy the public part of a served board."),
        "verify": (_RESULTS, "Check every signature, digest, log entry and score."),
    },
    "To host": {
        "init": (_HOST, "Create a board."),
        "serve": (_HOST, "Serve the board: its pages, and an API for submissions."),
        "score": (_HOST, "Score all waiting submissions."),
        "site": (_HOST, "Write the board as static pages."),
        **{name: COMMANDS[name] for name in ("season",) if name in COMMANDS},
        "admin": (_HOST, "Upkeep: your key, the index, the clock, files that nothing needs."),
        "demo": (_HOST, "Put a trained run through the whole pipeline."),
    },
    "Seasons": {name: command for name, command in COMMANDS.items() if name != "season"},
}

_UPKEEP = "is now `sme-leaderboard admin {}`."
_SUBMITTED = "is part of `sme-leaderboard submit RUNS BOARD`"


class _Commands(CommandGroup):
    exit_codes = ((Rejection, 1), (SealedError, 1), (TamperedError, 3))
    extra = "leaderboard"
    modules: ClassVar = {
        name: (module, summary, panel)
        for panel, commands in _PANELS.items()
        for name, (module, summary) in commands.items()
    }
    replaced: ClassVar = {
        "keygen": "`sme-leaderboard submit` creates your key; `admin key` shows it.",
        "new": f"{_SUBMITTED}; with --dry-run --out BUNDLE it writes a bundle and sends nothing.",
        "check": f"{_SUBMITTED}; with --dry-run it sends nothing.",
        **dict.fromkeys(
            ("export", "export-sb3"),
            f"{_SUBMITTED}, which reads .zip files of Stable-Baselines3; with VecNormalize, use "
            "`sme_registry.export_onnx(model, task, path, vec_normalize=…)`.",
        ),
        **{name: _UPKEEP.format(name) for name in ("reindex", "clock", "gc")},
    }


app = application(
    "sme-leaderboard",
    """A leaderboard that recomputes every score from the submitted policy.

    A board is a folder, or the address of one that is served. To take part:

      sme-leaderboard submit runs/smoke BOARD --method PPO --submitter "A Lab"

    To host one:

      sme-leaderboard init board

      sme-leaderboard serve board

    Exit codes: 0 success, 1 rejected, 2 invalid usage, 3 tampering detected.
    """,
    _Commands,
)


def main() -> None:
    """The entry point of the command `sme-leaderboard`."""
    app()


__all__ = ["app", "main"]
