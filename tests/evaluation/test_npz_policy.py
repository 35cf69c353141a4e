"""A trained policy in NumPy, and its file."""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import OfflinePolicy

SPEC = SMESpec(state_dim=2, action_dim=2)


def policy(seed: int = 0) -> OfflinePolicy:
    random = np.random.default_rng(seed)
    widths = [4, 8, 8, 2]
    layers = [
        (random.normal(size=(o, i)).astype(np.float32), random.normal(size=o).astype(np.float32))
        for i, o in itertools.pairwise(widths)
    ]
    return OfflinePolicy(layers, {"algorithm": "bc", "seed": seed})


def test_it_answers_as_the_network_it_was_taken_from() -> None:
    torch = pytest.importorskip("torch")
    from sme_registry.offline.networks import mlp, weights

    torch.manual_seed(0)
    network = mlp(4, (16, 8), 2)
    observations = np.random.default_rng(0).random((50, 4), dtype=np.float32)
    with torch.no_grad():
        expected = (1 + torch.tanh(network(torch.from_numpy(observations)))) / 2
    actions = OfflinePolicy(weights(network))(observations)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, atol=1e-6)


def test_a_saved_policy_is_read_again_to_the_bit(tmp_path: Path) -> None:
    saved = policy()
    path = saved.save(tmp_path / "deep" / "policy.npz")
    read = OfflinePolicy.load(path)
    assert read.about == saved.about
    observations = np.random.default_rng(0).random((5, 4), dtype=np.float32)
    np.testing.assert_array_equal(read(observations), saved(observations))
    assert policy().save(tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_evaluate_takes_it() -> None:
    report = evaluate(policy(), SPEC, {"states_per_region": 50})
    assert report.policy == "bc"
    assert report.action_range == "unit"


def test_another_task_is_refused() -> None:
    with pytest.raises(PolicyError, match=r"observations of shape \(50, 10\).*\[B, 4\]"):
        evaluate(policy(), SMESpec(), {"states_per_region": 50})


def stored(**changes: object) -> bytes:
    """A policy's file with some of its arrays changed; None leaves one out."""
    content = io.BytesIO()
    saved = policy()
    arrays: dict[str, object] = {
        "about": np.frombuffer(json.dumps({"kind": "sme-offline-policy"}).encode(), np.uint8),
        **{f"W{i}": W for i, (W, _) in enumerate(saved.layers)},
        **{f"b{i}": b for i, (_, b) in enumerate(saved.layers)},
    }
    arrays |= changes
    np.savez(content, **{name: array for name, array in arrays.items() if array is not None})  # type: ignore[arg-type]
    return content.getvalue()


def test_the_files_of_these_tests_are_read_where_nothing_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "policy.npz").write_bytes(stored())
    assert OfflinePolicy.load(tmp_path / "policy.npz").action_dim == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: b"", "not a policy"),
        (lambda: b"PK\x03\x04 cut", "not a policy"),
        (lambda: stored()[:-40], "not a policy"),
        (lambda: stored(about=None), "about"),
        (lambda: stored(about=np.frombuffer(b"{}", np.uint8)), "does not name its kind"),
        (lambda: stored(b1=None), "b1"),
        (lambda: stored(W1=np.zeros((8, 9), np.float32)), "layer 1 has shapes"),
        (lambda: stored(W0=np.zeros((8, 4))), "not float32"),
        (lambda: stored(b2=np.array([np.nan, 0], np.float32)), "not finite"),
        (lambda: stored(W0=np.array([[print]], object)), "not a policy"),
    ],
    ids=["empty", "no zip", "cut", "unsaid", "other", "gap", "shapes", "type", "nan", "pickle"],
)
def test_what_is_no_policy_is_refused(
    tmp_path: Path, content: Callable[[], bytes], message: str
) -> None:
    path = tmp_path / "policy.npz"
    path.write_bytes(content())
    with pytest.raises(PolicyError, match=message):
        OfflinePolicy.load(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"nothing\.npz does not exist"):
        OfflinePolicy.load(tmp_path / "nothing.npz")


def test_a_name_without_its_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"must end in \.npz"):
        policy().save(tmp_path / "policy")
