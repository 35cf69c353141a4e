"""Comparisons that raise `ConformanceError` with the expected and the actual value."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Collection
from typing import Any

import numpy as np

TOLERANCE = 1e-12  # of optimal actions and rewards between back-ends; states are equal bit for bit


class ConformanceError(AssertionError):
    """An environment violates a guarantee of SME environments.

    Examples:
      >>> from sme_registry.envs import SMEEnv
      >>> from sme_registry.testing import check_optimum
      >>> class Frozen(SMEEnv):
      ...     def step(self, action):
      ...         return super().step(0 * action)
      >>> check_optimum(sme_registry.SMESpec(horizon=5), single=Frozen)
      Traceback (most recent call last):
      ...
      sme_registry.testing.comparing.ConformanceError: ...
    """


def expect_equal(what: str, got: Any, expected: Any) -> None:
    """Check that two values are equal, arrays in every entry; NaN equals NaN."""
    if isinstance(got, np.ndarray | np.generic):
        same = np.array_equal(got, expected, equal_nan=True)
    else:
        same = got == expected
    if not same:
        raise ConformanceError(f"{what}: expected {expected!r:.200}, got {got!r:.200}.")


def expect_near(what: str, got: Any, expected: Any, tolerance: float = TOLERANCE) -> None:
    """Check that numbers differ by at most a tolerance."""
    difference = float(np.max(np.abs(np.asarray(got) - np.asarray(expected))))
    if not difference <= tolerance:
        raise ConformanceError(
            f"{what}: expected {expected!r:.200} to {tolerance:.0e}, got {got!r:.200}."
        )


def expect_passes(what: str, test: Callable[[], Any], ignored: Collection[str] = ()) -> None:
    """Check that another library's test passes, with no warnings but those ignored."""
    silence = contextlib.redirect_stdout(io.StringIO())
    with warnings.catch_warnings(record=True) as caught, silence:
        warnings.simplefilter("always")
        try:
            test()
        except Exception as error:
            raise ConformanceError(f"{what}: {error}") from error
    for message in (str(warning.message) for warning in caught):
        if message not in ignored:
            raise ConformanceError(f"{what}, warns: {message}")


def expect_same(what: str, got: Any, expected: Any) -> None:
    """Check equality in every bit, type and key; NaN equals NaN."""
    if isinstance(got, dict) and isinstance(expected, dict):
        expect_equal(f"{what}: the keys", sorted(got), sorted(expected))
        for key in got:
            expect_same(f"{what}: {key}", got[key], expected[key])
    elif isinstance(got, list | tuple) and isinstance(expected, list | tuple):
        expect_equal(f"{what}: the number of values", len(got), len(expected))
        for ours, theirs in zip(got, expected, strict=True):
            expect_same(what, ours, theirs)
    elif isinstance(got, np.ndarray) and got.dtype == object:
        expect_same(what, list(got), list(expected))
    elif isinstance(got, np.ndarray | np.generic):
        expect_equal(f"{what}: type", type(got), type(expected))
        expect_equal(f"{what}: dtype", got.dtype, expected.dtype)
        expect_equal(what, got, expected)
    else:
        expect_equal(what, got, expected)
