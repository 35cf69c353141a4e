"""A trained policy in NumPy, and its file."""

import io
import itertools
import json

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation.networks import OfflinePolicy

SPEC = SMESpec(state_dim=2, action_dim=2)
OBSERVATIONS = np.random.default_rng(0).random((50, 4), dtype=np.float32)


def policy():
    random = np.random.default_rng(0)
    layers = [
        (random.normal(size=(o, i)).astype(np.float32), random.normal(size=o).astype(np.float32))
        for i, o in itertools.pairwise([4, 8, 8, 2])
    ]
    return OfflinePolicy(layers, {"algorithm": "bc", "seed": 0})


def test_it_answers_as_the_network_it_was_taken_from():
    torch = pytest.importorskip("torch")
    from sme_registry.datasets.learners import mlp, weights

    torch.manual_seed(0)
    network = mlp(4, (16, 8), 2)
    with torch.no_grad():
        expected = (1 + torch.tanh(network(torch.from_numpy(OBSERVATIONS)))) / 2
    actions = OfflinePolicy(weights(network))(OBSERVATIONS)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, atol=1e-6)


def test_a_saved_policy_is_read_again_to_the_bit_and_scores_alike(tmp_path):
    saved = policy()
    path = saved.save(tmp_path / "deep" / "policy.npz")
    read = OfflinePolicy.load(path)
    assert read.about == saved.about
    np.testing.assert_array_equal(read(OBSERVATIONS), saved(OBSERVATIONS))
    assert policy().save(tmp_path / "again.npz").read_bytes() == path.read_bytes()

    live, of_file = (evaluate(each, SPEC, {"states_per_region": 50}) for each in (saved, str(path)))
    assert (live.policy, of_file.policy) == ("bc", "policy")
    assert live.action_range == "unit"
    assert of_file.regions == live.regions
    for other in (saved, path):
        with pytest.raises(PolicyError, match=r"actions of policy '\w+' are in \[0, 1\]"):
            evaluate(other, SPEC, {"states_per_region": 50}, action_range="symmetric")
        with pytest.raises(PolicyError, match=r"its observations have shape \(4,\): must be \(10"):
            evaluate(other, SMESpec(), {"states_per_region": 50})


def test_arrays_are_copied_as_float32_and_must_fit(tmp_path):
    W, b = np.zeros((2, 4)), np.ones(2)
    read = OfflinePolicy.load(OfflinePolicy([(W, b)]).save(tmp_path / "policy.npz"))
    W[0] = b[0] = 5.0  # the caller's own are left as they were
    np.testing.assert_allclose(read(OBSERVATIONS), 0.5 * (1 + np.tanh(1.0)), rtol=1e-6)
    with pytest.raises(PolicyError, match=r"layers\[0\], transposed: W has shape"):
        OfflinePolicy([(np.zeros((2, 4)), np.zeros(3))])
    with pytest.raises(PolicyError, match="1 to 64"):
        OfflinePolicy([])


def stored(**changes):
    """A policy's file with some of its arrays changed; None leaves one out."""
    content = io.BytesIO()
    arrays = {"about": np.frombuffer(json.dumps({"kind": "sme-offline-policy"}).encode(), np.uint8)}
    for i, (W, b, _) in enumerate(policy().layers):
        arrays |= {f"W{i}": W.T, f"b{i}": b}
    arrays |= changes
    np.savez(content, **{name: array for name, array in arrays.items() if array is not None})
    return content.getvalue()


def test_the_files_of_these_tests_are_read_where_nothing_is_wrong(tmp_path):
    (tmp_path / "policy.npz").write_bytes(stored())
    assert OfflinePolicy.load(tmp_path / "policy.npz").action_dim == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (stored()[:-40], "not a policy"),
        (stored(about=None), "about"),
        (stored(about=np.frombuffer(b"{}", np.uint8)), "does not name its kind"),
        (stored(b1=None), "b1"),
        (stored(W1=np.zeros((8, 9), np.float32)), r"layers\[1\], transposed: W has shape"),
        (stored(W0=np.zeros((8, 4))), "not float32"),
        (stored(b2=np.array([np.nan, 0], np.float32)), "NaN or infinity"),
        (stored(W0=np.array([[print]], object)), "not a policy"),
    ],
    ids=["cut", "unsaid", "other", "gap", "shapes", "type", "nan", "pickle"],
)
def test_what_is_no_policy_is_refused(tmp_path, content, message):
    path = tmp_path / "policy.npz"
    path.write_bytes(content)
    with pytest.raises(PolicyError, match=message):
        OfflinePolicy.load(path)


def test_a_missing_file_and_a_name_without_its_ending_are_refused(tmp_path):
    with pytest.raises(PolicyError, match=r"nothing\.npz does not exist"):
        OfflinePolicy.load(tmp_path / "nothing.npz")
    with pytest.raises(OptionError, match=r"must end in \.npz"):
        policy().save(tmp_path / "policy")
