"""Bundles: submissions as folders, and how to make them from training runs."""

from leaderboard.bundle.making import make_bundle
from leaderboard.bundle.reading import Bundle

__all__ = ["Bundle", "make_bundle"]
