"""The reference policies: 0 and 1 by construction, as files that any board would take."""

import numpy as np
import onnx
import pytest

from leaderboard.artefact.gate import inspect, widths
from leaderboard.artefact.reference import constant_onnx, optimal_onnx
from sme_registry import SMESpec, evaluate, materialize

SPECS = {
    "default": SMESpec(),
    "more actions than states": SMESpec(state_dim=2, action_dim=5, policy_init="unit_variance"),
    "one channel, one unit": SMESpec(state_dim=1, action_dim=1, complexity=3, hidden_width=1),
    "narrow and deep": SMESpec(state_dim=2, action_dim=16, complexity=20, hidden_width=8),
    "complexity 50": SMESpec(complexity=50, seed=3, policy_init="unit_variance"),
}
any_spec = pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)


def asked(data):
    """An ONNX file as a function of observations, on one thread."""
    import onnxruntime

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


def test_the_optimum_depends_on_the_state_alone():
    spec = SPECS["default"]
    act, seen = asked(optimal_onnx(spec)), observations(spec)
    other = seen.copy()
    other[:, -2:] += 7.0
    assert (act(seen) == act(other)).all()


def test_the_optimum_stays_in_the_unit_cube_however_far_the_state():
    spec = SPECS["default"]
    for scale in (100.0, 1e30):
        acted = asked(optimal_onnx(spec))(observations(spec, scale=scale))
        assert np.isfinite(acted).all()
        assert 0.0 <= acted.min() < 1e-9  # it does saturate there
        assert acted.max() == 1.0


def test_a_row_alone_is_acted_on_as_in_a_batch():
    spec = SPECS["complexity 50"]
    act, seen = asked(optimal_onnx(spec)), observations(spec)
    alone = np.concatenate([act(row[None]) for row in seen])
    assert np.abs(alone - act(seen)).max() <= 2**-24


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
        inspect(data, spec.state_dim + 2, spec.action_dim)
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
    inspect(data, *widths(TEAM))
    (tmp_path / "policy.onnx").write_bytes(data)
    report = evaluate(str(tmp_path / "policy.onnx"), TEAM, {"states_per_region": 500})
    for each in (report, *report.agents.values()):
        for region in each.regions:
            assert region.normalised_regret == pytest.approx(regret, abs=1e-6)
    assert list(report.agents) == ["scout_0", "driver_0", "driver_1"]
