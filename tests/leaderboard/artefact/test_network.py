"""A submitted file reaches a page as numbers: equal to what onnxruntime computes, or not at all."""

import numpy as np
import onnxruntime
import pytest

from leaderboard.artefact.network import network_of
from leaderboard.artefact.reference import constant_onnx, optimal_onnx
from leaderboard.web.site.explorers import can_show, explorer
from sme_registry import SMESpec
from sme_registry.export.export import onnx_bytes
from tests.explorer.networks import offline, perceptron
from tests.explorer.test_programs import module
from tests.leaderboard.artefact.models import doubling, looping, memory_bomb

SPEC = SMESpec(state_dim=3, action_dim=2)
HOSTILE = "</script><img src=x onerror=alert(1)>"
WIDTHS = 5, 2


@pytest.mark.parametrize("kind", ["tanh", "silu", "elu", "offline", "module", "normalised"])
def test_its_actions_are_those_of_the_runtime(kind):
    if kind in ("module", "normalised"):
        policy = module(SPEC, kind)
    else:
        policy = offline(SPEC) if kind == "offline" else perceptron(SPEC, kind)
    data = onnx_bytes(policy, SPEC)
    x = 2.0 * np.random.default_rng(0).random((64, 5), dtype=np.float32) - 0.5
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    network = network_of(data, *WIDTHS)
    assert network is not None
    np.testing.assert_allclose(network(x), session.run(None, {"observations": x})[0], atol=1e-5)


def test_the_constant_is_known_and_the_table_of_the_optimum_is_not():
    x = np.zeros((2, 5))
    assert network_of(constant_onnx(SPEC), *WIDTHS)(x).tolist() == [[0.5, 0.5], [0.5, 0.5]]
    assert network_of(optimal_onnx(SPEC), *WIDTHS) is None


def test_hostile_files_are_no_networks():
    good = onnx_bytes(perceptron(SPEC), SPEC)
    assert network_of(good, *WIDTHS) is not None
    assert network_of(good, 6, 2) is None
    assert network_of(b"", *WIDTHS) is None
    for cut in range(0, len(good), 97):
        network_of(good[:cut], *WIDTHS)
        changed = bytearray(good)
        changed[cut] ^= 0x5A
        network_of(bytes(changed), *WIDTHS)
    for bad in (looping(), memory_bomb(), doubling(40)):
        assert network_of(bad.SerializeToString(), *WIDTHS) is None


def test_a_page_says_what_it_cannot_compute_and_escapes_names():
    page = explorer(HOSTILE, onnx_bytes(perceptron(SPEC), SPEC), SPEC)
    assert HOSTILE not in page
    assert page.count("<img") == 0
    assert '<script src="../static/explorer.js"></script>' in page
    assert '"of":"observation"' in page
    unknown = explorer(HOSTILE, optimal_onnx(SPEC), SPEC)
    assert "cannot compute the network" in unknown
    assert '"of":"observation"' not in unknown
    assert can_show(SPEC)
    assert not can_show(SMESpec(state_dim=600))
