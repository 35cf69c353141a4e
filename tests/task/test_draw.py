"""The drawn numbers, and which stream each comes from.

Fingerprints fix the numbers of the catalogue; certificates find what METHOD asks of them.
"""

import math
import tracemalloc

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.spec import SMESpec
from sme_registry.task import draw, loading, materialize
from sme_registry.task.loading import _draw

GRID = 2.0**29


@pytest.mark.parametrize("state_dim", [1, 2, 2**20])
def test_rows_sum_to_one_at_every_width(state_dim):
    W = draw.transition_matrix(SMESpec(state_dim=state_dim, action_dim=2))
    assert [math.fsum(row) for row in W] == [1.0, 1.0]
    assert (W >= 0).all()
    np.testing.assert_array_equal(W * GRID, np.rint(W * GRID))


def test_uniform_numbers_are_never_zero_or_one():
    lowest, highest = draw.to_uniform(np.array([0, 2**64 - 1], np.uint64))
    assert 0.0 < lowest < highest < 1.0


# What a spec's field may change, and nothing else. Parts of a task: W, b, each layer by its stream.
BASE = {"state_dim": 6, "action_dim": 3, "complexity": 3, "hidden_width": 5, "seed": 11}
PARTS = {"W", "b", "inner/0", "inner/1", "output"}
FIELDS = [
    # field, other value, the parts that change
    ("k", 7, set()),
    ("r_min", 0.5, set()),
    ("D", 0.5, set()),
    ("horizon", 17, set()),
    ("rotation", 0.5, {"inner/0"}),
    ("complexity", 4, {"inner/2"}),
    ("complexity", 2, {"inner/1"}),
    ("hidden_width", 4, {"inner/0", "inner/1", "output"}),
    ("state_dim", 7, {"W", "b", "inner/0"}),
    ("action_dim", 2, {"W", "output"}),
    ("seed", 12, PARTS),
    ("seed", "0xb", PARTS),
    ("policy_init", "unit_variance", {"inner/0"}),  # where it widens: from 6 to 9
    ("team", {"agents": [{"action_dim": 3}], "reward": "team"}, set()),
    ("safety", {"tightness": 0.2}, {"safety"}),
    ("shaping", {"scale": 3.0}, {"shaping"}),
    ("noise", {"reward": 0.1, "transition": 0.1}, set()),
    ("observation", {"distractors": 2}, set()),
    ("observation", {"distractors": 2, "dynamics": "driven"}, {"distractors"}),
    ("observation", {"mixing": "nonlinear", "mixing_depth": 2}, {"mixing/0", "mixing/1"}),
]


def parts(task):
    named = {f"inner/{i}": layer.W for i, layer in enumerate(task.policies[0][:-1])}
    if task.limiting:
        named["safety"] = task.limiting[-1].W
    if task.distractor_transition:
        named["distractors"] = task.distractor_transition[0]
    named |= {f"mixing/{i}": layer.W for i, layer in enumerate(task.mixing)}
    if task.shaping:
        named["shaping"] = task.shaping[0].W
    return {"W": task.W, "b": task.b, **named, "output": task.policies[0][-1].W}


@pytest.mark.parametrize(("field", "value", "changes"), FIELDS)
def test_a_field_changes_the_parts_it_should_and_no_others(field, value, changes):
    assert {name for name, *_ in FIELDS} == SMESpec.model_fields.keys() - {"schema_version"}
    wide = {"hidden_width": 9} if value == "unit_variance" else {}
    base = materialize(SMESpec.from_dict(BASE | wide))
    other = materialize(SMESpec.from_dict(BASE | wide | {field: value}))
    before, after = parts(base), parts(other)
    changed = {
        name for name in before.keys() | after.keys()
        if name not in before or name not in after or not np.array_equal(before[name], after[name])
    }  # fmt: skip
    assert changed == changes, (field, value)
    assert base.spec.digest != other.spec.digest


def test_the_same_spec_is_the_same_task_bit_for_bit_and_cannot_be_written_to():
    one, other = (_draw(SMESpec(complexity=3, seed="0xabc")) for _ in range(2))
    for mine, its in zip(one.arrays, other.arrays, strict=True):
        np.testing.assert_array_equal(mine, its)
        with pytest.raises(ValueError, match="read-only"):
            mine[...] = 0.0


def test_counted_numbers_are_those_of_splitmix64_whatever_is_drawn_with_them():
    # Published for the seed 1234567: https://rosettacode.org/wiki/Pseudo-random_numbers/Splitmix64
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    with np.errstate(over="ignore"):
        places = np.uint64(1234567) + draw.GOLDEN * np.arange(1, 4, dtype=np.uint64)
    assert draw.mixed_bits(places).tolist() == published
    keys, first = np.array([5, 2**52 - 1, 0], np.uint64), np.array([1, 900, 7], np.uint64)
    together = draw.counted(keys, first, 40)
    assert ((together > 0) & (together < 1)).all()
    for row, key, place in zip(together, keys, first, strict=True):
        for i in (0, 17, 39):
            alone = draw.counted(key[None], (place + np.uint64(i))[None], 1)
            assert alone.item() == row[i]


TOO_LARGE = [
    SMESpec(state_dim=2**20, action_dim=2**20),
    SMESpec(complexity=10_000, hidden_width=4096),
    SMESpec(
        complexity=10_000, hidden_width=4096, action_dim=1024,
        team={"agents": [{"action_dim": 1}] * 1024},
    ),
    SMESpec(action_dim=2**20, observation={"distractors": 2**20, "dynamics": "autonomous"}),
    SMESpec(observation={"distractors": 2**17, "mixing": "orthogonal"}),
]  # fmt: skip


@pytest.mark.parametrize("spec", TOO_LARGE)
def test_a_task_that_cannot_fit_is_refused_and_nothing_is_allocated(spec):
    tracemalloc.start()
    try:
        with pytest.raises(ResourceLimitError) as caught:
            materialize(spec)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    gib = loading.peak_bytes(spec) / 2**30
    assert gib > 4
    assert f"would need {gib:.1f} GiB" in message
    assert f"set SME_MEMORY_LIMIT_GIB above {gib:.1f}." in message
    assert "the limit is 4 GiB" in message
    assert "Make one of these smaller." in message
    assert isinstance(caught.value, MemoryError)
    assert peak < 2**20


def test_environments_batches_and_files_that_cannot_fit_are_refused_too(tmp_path):
    with pytest.raises(ResourceLimitError):
        sme_registry.make(TOO_LARGE[0])
    with pytest.raises(ResourceLimitError):
        sme_registry.save(TOO_LARGE[0], tmp_path / "large.json")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ResourceLimitError, match="num_envs=1000000000: a batch this large"):
        sme_registry.make_vec(SMESpec(), 10**9)


@pytest.mark.parametrize(
    "fields",
    [
        {"state_dim": 50_000, "action_dim": 1},
        {"state_dim": 1, "action_dim": 10_000},
        {"complexity": 20, "policy_init": "unit_variance"},
        {"complexity": 2, "state_dim": 4096, "action_dim": 4, "hidden_width": 1},
        {"action_dim": 40, "team": {"agents": [{"action_dim": 10}] * 4}, "complexity": 4},
        {"complexity": 3, "hidden_width": 150, "safety": {"tightness": 0.2}},
        {"action_dim": 150, "observation": {"distractors": 200, "dynamics": "driven"}},
        {"observation": {"distractors": 120, "mixing": "orthogonal"}},
        {"observation": {"distractors": 120, "mixing": "nonlinear", "mixing_depth": 3}},
    ],
)
def test_the_estimate_is_above_what_a_draw_takes_and_not_by_far(fields):
    spec = SMESpec.from_dict(fields)
    _draw(spec)  # imports and caches of first use are no part of it
    tracemalloc.start()
    task = _draw(spec)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    slack = 2**16  # Python's own objects
    assert peak <= loading.peak_bytes(spec) + slack
    assert loading.peak_bytes(spec) <= 8 * (peak + slack)
    held = sum(array.nbytes for array in task.arrays)
    assert loading.parameter_bytes(spec) == held


def test_the_limit_can_be_set_higher_and_lower(monkeypatch):
    spec = SMESpec(state_dim=100, action_dim=100)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "0.0001")
    with pytest.raises(ResourceLimitError, match=r"the limit is 0\.0001 GiB"):
        materialize(spec)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "0.01")
    assert materialize(spec).W.shape == (100, 100)
    for limit in ("16", "4"):
        monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", limit)
        with pytest.raises(ResourceLimitError, match=f"the limit is {limit} GiB"):
            loading.check_memory(int(float(limit) * 2**30) + 1, "It", "")
        loading.check_memory(int(limit) * 2**30, "It", "")
    monkeypatch.delenv("SME_MEMORY_LIMIT_GIB")
    loading.check_memory(4 * 2**30, "It", "")


def test_a_limit_that_is_no_positive_number_is_refused(monkeypatch):
    for text in ("", "0", "-1", "nan", "1e300", "4 GiB"):
        monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", text)
        with pytest.raises(OptionError, match=f"_GIB={text!r}: must be a positive number of GiB"):
            materialize(SMESpec())
