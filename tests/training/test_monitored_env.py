"""The monitored environment: the numbers of `SMEVecEnv`, and their sums."""

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec

pytest.importorskip("stable_baselines3")

SPEC = SMESpec(state_dim=3, action_dim=2, k=2, D=0.01, horizon=3)


STREAM = StreamSpec(
    phases=[{"spec": SPEC, "steps": 40}, {"spec": SPEC.derive(seed=1, k=1), "steps": 40}],
    switch="step",
    observes_phase=True,
)


@pytest.mark.parametrize(
    ("document", "action_range"), [(SPEC, "unit"), (STREAM, "symmetric")], ids=["task", "stream"]
)
def test_steps_equal_those_of_a_batch_of_one(document, action_range):
    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training.monitored_env import MonitoredVecEnv

    batch = SMEVecEnv(document, 1, action_range=action_range)
    monitored = MonitoredVecEnv(document, action_range=action_range)
    assert monitored.action_space == batch.action_space
    assert monitored.observation_space == batch.observation_space
    for env in (batch, monitored):
        env.seed(7)
    np.testing.assert_array_equal(monitored.reset(), batch.reset())
    calls = []
    monitored.after_step = calls.append
    centre = (
        monitored.action_space.low[0] + 1.0
    ) / 2.0  # where some episodes end early and some do not
    noise = np.random.default_rng(0).normal(scale=0.2, size=(300, 1, 2))
    actions = (centre + noise).astype(np.float32)
    regrets, ends = [], set()
    for action in actions:
        ours, theirs = monitored.step(action), batch.step(action)
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
    assert monitored.steps == 300
    assert calls == list(range(1, 301))
    assert monitored.regret == pytest.approx(sum(regrets))
    assert monitored.seconds > 0.0
    monitored.set_options({"state": [0.1, 0.2, 0.3]})
    np.testing.assert_allclose(monitored.reset()[0, :3], [0.1, 0.2, 0.3], atol=1e-7)
    assert monitored.reset()[0, 0] != pytest.approx(0.1)
