"""The command `sme`."""

from sme_registry.cli.app import app, main

__all__ = ["app", "main"]
