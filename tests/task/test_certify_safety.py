"""Certificates of limits: sound ones pass, and each check can fail."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.task import Layer, Task, materialize
from sme_registry.task.certify import certify
from sme_registry.task.certify_safety import safety_checks
from tests.task.test_certify import check

SAFE = SMESpec(safety={"tightness": 0.2}, policy_init="unit_variance")
NAMES = {"broken_limits", "limit_uniformity", "states_with_a_broken_limit", "price_of_safety"}


def changed(scale: float = 1.0, shift: float = 0.0) -> Task:
    """A task whose v has another last layer."""
    task = materialize(SAFE)
    *layers, (W, b) = task.limiting
    return dataclasses.replace(task, limiting=(*layers, Layer(W * scale, b * scale + shift)))


@pytest.mark.parametrize("tightness", [0.05, 0.2, 0.5])
def test_the_optimum_breaks_its_limits_in_the_share_that_the_tightness_says(
    tightness: float,
) -> None:
    shares, prices = [], []
    for seed in range(10):
        task = materialize(SAFE.derive(safety={"tightness": tightness}, seed=seed))
        broken, uniformity, *_, price = safety_checks(task, 0, 4_000)
        assert (broken.low, broken.high) == (0.5 * tightness, 1.5 * tightness)
        assert uniformity.outcome == "passed"
        shares.append(broken.value)
        prices.append(price.value)
    assert np.mean(shares) == pytest.approx(tightness, rel=0.15)  # SD over draws: at most 0.2 τ
    if tightness == 0.2:
        assert price.name == "price_of_safety"
        assert np.mean(prices) == pytest.approx(0.105, abs=0.02)  # METHOD, section 8


def test_a_sound_task_passes_with_the_price_of_what_its_safe_action_earns_less() -> None:
    certificate, task = certify(SAFE), materialize(SAFE)
    assert certificate.outcome == "passed"
    s = np.random.default_rng(0).random((20_000, 8))
    price = np.mean(task.regret(s, task.safe_action(s)))
    assert check(certificate, "price_of_safety").value == pytest.approx(price, abs=0.01)
    states = check(certificate, "states_with_a_broken_limit").value
    channels = check(certificate, "broken_limits").value
    assert channels < states < 4 * channels  # type: ignore[operator]
    assert not {each.name for each in certify(SMESpec()).checks} & NAMES


def test_limits_that_have_collapsed_are_refused() -> None:
    found = check(certify(changed(scale=0.05)), "limit_uniformity")
    assert found.outcome == "refused"
    assert found.value == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("shift", "share"), [(-5.0, 0.0), (5.0, 0.4)])
def test_limits_that_never_or_too_often_bind_are_refused(shift: float, share: float) -> None:
    found = check(certify(changed(shift=shift)), "broken_limits")
    assert found.outcome == "refused"
    assert found.value == pytest.approx(share, abs=0.01)


def test_policies_that_stay_near_the_middle_seldom_reach_their_limits() -> None:
    middling = SAFE.derive(complexity=2, policy_init="semi_orthogonal", safety={"tightness": 0.1})
    spread = middling.derive(policy_init="unit_variance")
    for spec, outcome in ((middling, "refused"), (spread, "passed")):
        broken, *_ = safety_checks(materialize(spec), 0, 4_000)
        assert (broken.name, broken.outcome) == ("broken_limits", outcome)


def test_a_layer_of_v_is_held_to_the_rules_of_the_layers_of_the_optimum() -> None:
    task = materialize(SAFE)
    ((W, b),) = task.limiting
    W = W.copy()
    W[0, 0] += 1e-6
    skewed = certify(dataclasses.replace(task, limiting=(Layer(W, b),)))
    assert check(skewed, "layers_orthogonal").outcome == "refused"
    assert check(certify(changed(shift=1e-6)), "layers_centred").outcome == "refused"
