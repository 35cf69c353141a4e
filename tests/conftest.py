"""Shared by every test: Hypothesis draws the same examples on every run and machine."""

from hypothesis import settings

settings.register_profile(
    "deterministic", derandomize=True, deadline=None, database=None, max_examples=50
)
settings.load_profile("deterministic")
