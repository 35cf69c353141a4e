"""Updates of TD3 and SAC equal Stable-Baselines3's, in wide actions and in padded ones."""

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("stable_baselines3")

from sme_registry.jax.sac import SAC, SACProgram
from sme_registry.jax.td3 import TD3, TD3Program
from tests.jax import sb3_replay
from tests.jax.sb3_replay import BATCH, NET_ARCH

SETTINGS = {"net_arch": NET_ARCH, "batch_size": BATCH}
KINDS = [(TD3Program, TD3(**SETTINGS)), (SACProgram, SAC(**SETTINGS))]


@pytest.fixture(scope="module", params=KINDS, ids=["TD3", "SAC"])
def lanes(request):
    return sb3_replay.replay(*request.param)


@pytest.mark.parametrize("lane", [0, 1], ids=["A=16", "padded"])
def test_updates_equal_those_of_stable_baselines3(lanes, lane):
    replayed = lanes[lane]
    for updates, tolerance in ((1, 1e-6), (10, 1e-5)):
        theirs = replayed.theirs[updates]
        assert sb3_replay.greatest_difference(theirs, replayed.before) > 100 * tolerance
        assert sb3_replay.greatest_difference(theirs, replayed.ours[updates]) < tolerance


def test_padded_weights_remain_zero(lanes):
    for name, weight in lanes[1].padded[10].items():
        assert np.count_nonzero(weight) == np.count_nonzero(lanes[1].ours[10][name])
