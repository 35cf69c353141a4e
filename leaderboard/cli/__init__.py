"""The command `sme-leaderboard`."""

from leaderboard.cli.app import app, main

__all__ = ["app", "main"]
