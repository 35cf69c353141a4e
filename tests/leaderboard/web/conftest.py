"""Shared by tests of the web application."""

import os

import pytest

from tests.leaderboard.serving import serving


@pytest.fixture(scope="package", autouse=True)
def _no_fsync():
    """A loss of power is not what these tests are about; tests of the store are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture
def url(store):
    """The URL of the tiny board of `store`."""
    with serving(store.folder.path) as url:
        yield url
