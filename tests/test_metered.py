"""The environment that keeps the books: `SMEVecEnv`'s numbers, and the right sums of them."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from sme_registry import SMESpec

pytest.importorskip("stable_baselines3")

SPEC = SMESpec(state_dim=3, action_dim=2, k=2, D=0.01, horizon=3)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
def test_its_steps_are_those_of_a_batch_of_one(action_range: Literal["unit", "symmetric"]) -> None:
    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training.metered import MeteredVecEnv

    batch: Any = SMEVecEnv(SPEC, 1, action_range=action_range)
    metered: Any = MeteredVecEnv(SPEC, action_range=action_range)
    assert metered.action_space == batch.action_space
    assert metered.observation_space == batch.observation_space
    for env in (batch, metered):
        env.seed(7)
    np.testing.assert_array_equal(metered.reset(), batch.reset())
    heard: list[int] = []
    metered.after_step = heard.append
    centre = (metered.action_space.low[0] + 1.0) / 2.0  # whence some episodes last, and some end
    noise = np.random.default_rng(0).normal(scale=0.2, size=(300, 1, 2))
    actions = (centre + noise).astype(np.float32)
    regrets, ends = [], set()
    for action in actions:
        ours, theirs = metered.step(action), batch.step(action)
        for mine, its in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(mine, its)
            assert mine.dtype == its.dtype
        info, expected = ours[3][0], theirs[3][0]
        assert info.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_array_equal(info[key], value)
        regrets.append(expected["regret"])
        if ours[2][0]:
            ends.add(info["TimeLimit.truncated"])
    assert ends == {True, False}
    assert metered.steps == 300
    assert heard == list(range(1, 301))
    assert metered.regret == pytest.approx(sum(regrets))
    assert metered.seconds > 0.0


def test_it_begins_where_it_is_told() -> None:
    from sme_registry.training.metered import MeteredVecEnv

    env: Any = MeteredVecEnv(SPEC, action_range="unit")
    env.set_options({"state": [0.1, 0.2, 0.3]})
    np.testing.assert_allclose(env.reset()[0, :3], [0.1, 0.2, 0.3], atol=1e-7)
    assert env.reset()[0, 0] != pytest.approx(0.1)
    assert env.get_attr("sme_spec") == [SPEC]
