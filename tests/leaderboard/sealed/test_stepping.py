"""The lanes of a hidden instance equal single environments."""

import numpy as np

from leaderboard.sealed.stepping import Lanes, Start
from sme_registry import SMESpec
from sme_registry.envs import SMEEnv

SPEC = SMESpec(state_dim=3, action_dim=2, complexity=5, horizon=3, k=2, D=0.1, seed=11)
SEED = 2**255 + 3


def test_steps_and_regret_are_those_of_single_environments():
    lanes, unmeasured = Lanes(Start(SPEC, SEED), 3), Lanes(Start(SPEC, SEED), 3)
    singles = [SMEEnv(SPEC) for _ in range(3)]
    first = [env.reset(seed=SEED + lane)[0] for lane, env in enumerate(singles)]
    np.testing.assert_array_equal(lanes.observation, first)
    random = np.random.default_rng(1)
    seen = set()
    for _ in range(60):
        actions = random.random((3, 2), dtype=np.float32) * 1.2 - 0.1
        regret = half = 0.0
        expected = []
        for lane, env in enumerate(singles):
            half += float(env.task.regret(env.state, np.full(2, 0.5)))
            observation, reward, terminated, truncated, info = env.step(actions[lane])
            regret += info["regret"]
            last = np.zeros(5, np.float32)
            if terminated or truncated:
                last, observation = observation, env.reset()[0]
            expected.append((observation, np.float32(reward), terminated, truncated, last))
            seen.add((terminated, truncated))
        steps, measured = lanes.step_with_regret(actions)
        plain = unmeasured.step(actions)
        for got, same, wanted in zip(steps, plain, zip(*expected, strict=True), strict=True):
            np.testing.assert_array_equal(got, wanted)
            np.testing.assert_array_equal(same, wanted)
        np.testing.assert_array_equal(lanes.observation, steps.observation)
        np.testing.assert_allclose(measured, (regret, half), rtol=1e-12)
    assert {(False, False), (True, False), (False, True)} <= seen
