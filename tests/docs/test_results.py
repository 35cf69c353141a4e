"""The scripts beside the pages of results find what the pages say, on less."""

import importlib
import sys
from pathlib import Path

import pytest

from sme_registry import load, materialize

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(RESULTS)

    def imported(name):
        sys.modules.pop(name, None)
        return importlib.import_module(name)

    return imported


def test_a_plan_without_cost_beats_the_safe_projection_but_not_where_its_price_is_paid(
    script, monkeypatch
):
    plans = script("safe_plans")
    monkeypatch.setattr(plans, "EPISODES", 2)
    monkeypatch.setattr(plans, "SEQUENCES", 64)
    for name, gain in (("Safety40", 5.0), ("CompensatedSafety40", 0.0)):
        task = materialize(load(name).derive(horizon=40))
        earned, cost = plans.planned(task, 0)
        assert (cost == 0.0).all()
        assert earned.mean() >= plans.projected(task, 0).mean() + gain - 1e-9
        if task.spec.compensated:
            assert earned.max() <= 40.0 + 1e-9
