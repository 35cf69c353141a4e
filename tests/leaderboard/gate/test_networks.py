"""Reference policies, as files that any board would take; submitted files, as numbers on a page."""

import numpy as np
import onnx
import onnxruntime
import pytest

from leaderboard.gate.networks import can_show, constant_onnx, explorer, network_of, optimal_onnx
from leaderboard.gate.sandbox import inspect_own, widths
from sme_registry import SMESpec, evaluate, materialize
from sme_registry.export import onnx_bytes
from tests.explorer.networks import offline, perceptron
from tests.explorer.test_programs import module
from tests.leaderboard.gate.models import doubling, looping, memory_bomb

SPECS = {
    "default": SMESpec(),
    "more actions than states": SMESpec(state_dim=2, action_dim=5, policy_init="unit_variance"),
    "one channel, one unit": SMESpec(state_dim=1, action_dim=1, complexity=3, hidden_width=1),
    "complexity 50": SMESpec(complexity=50, seed=3, policy_init="unit_variance"),
}
any_spec = pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)


def asked(data):
    """An ONNX file as a function of observations, on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    return lambda observations: session.run(["actions"], {"observations": observations})[0]


def observations(spec, rows=64, scale=2.0):
    s = np.random.default_rng(0).random((rows, spec.state_dim + 2)) * scale - (scale - 1.0) / 2.0
    return s.astype(np.float32)


@any_spec
def test_the_optimum_is_the_nearest_float32_action_and_has_no_regret_in_any_region(spec):
    act, seen = asked(optimal_onnx(spec)), observations(spec)
    exact = materialize(spec).optimal_action(seen[:, : spec.state_dim].astype(np.float64))
    assert act(seen).dtype == np.float32
    assert np.abs(act(seen) - exact).max() <= 2**-25 + 1e-10
    report = evaluate(act, spec, {"states_per_region": 100})
    assert max(region.normalised_regret for region in report.regions) <= 3e-7


def test_the_optimum_depends_on_the_state_alone_and_stays_in_the_unit_cube():
    spec = SPECS["default"]
    act, seen = asked(optimal_onnx(spec)), observations(spec)
    other = seen.copy()
    other[:, -2:] += 7.0
    assert (act(seen) == act(other)).all()
    for scale in (100.0, 1e30):
        acted = act(observations(spec, scale=scale))
        assert np.isfinite(acted).all()
        assert 0.0 <= acted.min() < 1e-9  # it does saturate there
        assert acted.max() == 1.0


@any_spec
def test_the_constant_is_exactly_one_half_everywhere(spec):
    act = asked(constant_onnx(spec))
    for scale in (1.0, 1e30):
        acted = act(observations(spec, scale=scale))
        assert acted.shape == (64, spec.action_dim)
        assert (acted == 0.5).all()
    report = evaluate(act, spec, {"states_per_region": 10})
    assert [region.normalised_regret for region in report.regions] == [1.0] * 6


@any_spec
def test_any_board_takes_the_files_and_the_same_spec_gives_the_same_bytes(spec):
    for made in (optimal_onnx, constant_onnx):
        data = made(spec)
        assert made(spec) == data
        inspect_own(data, spec.state_dim + 2, spec.action_dim)
        assert len(onnx.load_from_string(data).graph.node) <= 13 * spec.complexity + 2


TEAM = SMESpec(
    state_dim=4,
    action_dim=5,
    complexity=3,
    k=5,
    team={
        "agents": [
            {"name": "scout_0", "action_dim": 1, "observes": [0, 3]},
            {"name": "driver_0", "action_dim": 3},
            {"name": "driver_1", "action_dim": 1, "observes": [2]},
        ]
    },
)


@pytest.mark.parametrize(("made", "regret"), [(optimal_onnx, 0.0), (constant_onnx, 1.0)])
def test_a_teams_reference_is_one_file_for_all_agents(made, regret, tmp_path):
    data = made(TEAM)
    inspect_own(data, *widths(TEAM))
    (tmp_path / "policy.onnx").write_bytes(data)
    report = evaluate(str(tmp_path / "policy.onnx"), TEAM, {"states_per_region": 500})
    for each in (report, *report.agents.values()):
        for region in each.regions:
            assert region.normalised_regret == pytest.approx(regret, abs=1e-6)
    assert list(report.agents) == ["scout_0", "driver_0", "driver_1"]


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
    np.testing.assert_allclose(network_of(data, *WIDTHS)(x), asked(data)(x), atol=1e-5)


def test_the_constant_is_known_and_the_table_of_the_optimum_is_not():
    x = np.zeros((2, 5))
    assert network_of(constant_onnx(SPEC), *WIDTHS)(x).tolist() == [[0.5, 0.5], [0.5, 0.5]]
    assert network_of(optimal_onnx(SPEC), *WIDTHS) is None


def test_hostile_files_are_no_networks():
    good = onnx_bytes(perceptron(SPEC), SPEC)
    assert network_of(good, *WIDTHS) is not None
    assert network_of(good, 6, 2) is None
    assert network_of(b"", *WIDTHS) is None
    for cut in range(0, len(good), 1200):
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
