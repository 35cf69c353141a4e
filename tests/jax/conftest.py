"""Fixtures of the tests in JAX."""

import pytest


@pytest.fixture(scope="module")
def quickly_compiled():
    """In half the time: for programs that are not compared with another library's last bits."""
    jax = pytest.importorskip("jax")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
