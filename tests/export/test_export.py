"""Exported policies act as they did before, pass a board's checks, and what cannot is refused."""

import sys

import numpy as np
import pytest

from leaderboard.gate.sandbox import inspect_own
from sme_registry import SMESpec, evaluate, export_onnx
from sme_registry.errors import MissingDependencyError, OptionError, PolicyError
from sme_registry.evaluation import Perceptron
from sme_registry.evaluation.networks import OfflinePolicy

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

SPEC = SMESpec(state_dim=3, action_dim=2)
PROTOCOL = {"states_per_region": 100}


def arrays(*shape, scale=1.0):
    return np.random.default_rng(sum(shape)).normal(scale=scale, size=shape).astype(np.float32)


def same(policy, path, action_range="unit", act=None):
    """The file scores as the policy does, and a board accepts it."""
    exported = evaluate(path, SPEC, PROTOCOL)
    own = evaluate(policy if act is None else act, SPEC, PROTOCOL, action_range=action_range)
    assert exported.action_range == "unit"
    for found, expected in zip(exported.regions, own.regions, strict=True):
        assert found.normalised_regret == pytest.approx(expected.normalised_regret, abs=1e-5)
    assert own.regions[0].similarity_sd > 0.02  # no constant
    inspect_own(path.read_bytes(), SPEC.state_dim + 2, SPEC.action_dim)


LAYERS = [(arrays(5, 16), arrays(16), "tanh"), (arrays(16, 2), arrays(2), "identity")]


@pytest.mark.parametrize(
    ("hidden", "action_range"),
    [
        *((hidden, "symmetric") for hidden in ("identity", "relu", "sigmoid", "silu", "elu")),
        ("tanh", "unit"),
    ],
)
def test_arrays_are_exported_without_pytorch(hidden, action_range, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    policy = Perceptron([(*LAYERS[0][:2], hidden), LAYERS[1]])
    path = export_onnx(policy, SPEC, tmp_path / "a" / "policy.onnx", action_range=action_range)
    same(policy, path, action_range)
    model = onnx.load(path)
    assert {prop.key: prop.value for prop in model.metadata_props} == {"action_range": "unit"}


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_a_policy_that_sees_distractors_is_exported(tmp_path):
    observed = {"distractors": 4, "mixing": "orthogonal"}
    spec = SPEC.derive(safety={"tightness": 0.2}, observation=observed)
    policy = Perceptron([(arrays(9, 2), np.zeros(2), "identity")])
    path = export_onnx(policy, spec, tmp_path / "wide.onnx")
    exported, own = (evaluate(one, spec, PROTOCOL) for one in (path, policy))
    for found, expected in zip(exported.regions, own.regions, strict=True):
        assert found.normalised_regret == pytest.approx(expected.normalised_regret, abs=1e-5)
    refused(policy, tmp_path, r"have shape \(9,\): must be \(5,\)", SPEC)


def test_an_offline_policy_is_exported(tmp_path):
    layers = [(arrays(16, 5), arrays(16)), (arrays(2, 16), arrays(2))]
    policy = OfflinePolicy(layers)
    same(policy, export_onnx(policy, SPEC, tmp_path / "policy.onnx"))
    saved = policy.save(tmp_path / "policy.npz")
    again = export_onnx(saved, SPEC, tmp_path / "again.onnx")
    assert again.read_bytes() == (tmp_path / "policy.onnx").read_bytes()


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([], "at least one"),
        ([(np.ones((5, 2)), np.zeros(3), "tanh")], r"W has shape \(5, 2\) and b \(3,\)"),
        ([LAYERS[0], (np.ones((2, 16)), np.zeros(2), "tanh")], r"must be \(16, out\).*Transpose"),
        (
            [(np.ones((5, 2)), np.zeros(2), "tahn")],
            "activation='tahn': must be .*'tanh'",
        ),
        ([(np.full((5, 2), np.nan), np.zeros(2), "tanh")], "NaN or infinity"),
        ([(np.ones((5, 2)), np.zeros(2))], r"must be \(W, b, activation\)"),
    ],
)
def test_arrays_that_are_no_network_are_refused(layers, message):
    with pytest.raises(PolicyError, match=message):
        Perceptron(layers)


def refused(policy, tmp_path, message, spec=SPEC, **options):
    target = tmp_path / "out" / "policy.onnx"
    with pytest.raises(PolicyError, match=message):
        export_onnx(policy, spec, target, **options)
    assert not target.parent.exists()


def test_other_names_and_places_are_refused(tmp_path):
    with pytest.raises(OptionError, match=r"must end in \.onnx"):
        export_onnx(Perceptron(LAYERS), SPEC, tmp_path / "policy.pt")
    (tmp_path / "file").write_text("")
    with pytest.raises(OptionError, match="cannot be written"):
        export_onnx(None, SPEC, tmp_path / "file" / "policy.onnx")
    refused(Perceptron(LAYERS), tmp_path, r"have shape \(5,\): must be \(10,\)", SMESpec())
    refused("policy.pt", tmp_path, r"must be the path of a \.zip or an \.npz")
    refused(3, tmp_path, r"must be a torch\.nn\.Module")


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("sme_registry.io.system.is_installed", lambda name: name != "onnx")
    with pytest.raises(MissingDependencyError, match=r"onnx is not installed.*\[onnx\]"):
        export_onnx(Perceptron(LAYERS), SPEC, tmp_path / "policy.onnx")


def test_the_recorded_range_of_a_file_is_used(tmp_path):
    path = export_onnx(Perceptron(LAYERS), SPEC, tmp_path / "policy.onnx")
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"action_range": "symmetric"})
    path.write_bytes(model.SerializeToString())
    assert evaluate(path, SPEC, PROTOCOL).action_range == "symmetric"
    assert evaluate(path, SPEC, PROTOCOL, action_range="unit").action_range == "unit"


def test_the_policy_that_a_team_shares_is_exported(tmp_path):
    team = SMESpec(action_dim=2, team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
    policy = Perceptron([(arrays(12, 1), np.full(1, 0.5), "sigmoid")])
    path = export_onnx(policy, team, tmp_path / "policy.onnx")
    exported, own = (evaluate(each, team, PROTOCOL) for each in (path, policy))
    assert exported.wd_regret == pytest.approx(own.wd_regret, abs=1e-5)
