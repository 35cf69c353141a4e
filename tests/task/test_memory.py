"""What cannot fit is refused before anything is drawn."""

import tracemalloc

import pytest

import sme_registry
from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.spec import SMESpec
from sme_registry.task import materialize, memory
from sme_registry.task.loading import _draw

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
    gib = memory.peak_bytes(spec) / 2**30
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
    assert peak <= memory.peak_bytes(spec) + slack
    assert memory.peak_bytes(spec) <= 8 * (peak + slack)
    held = sum(array.nbytes for array in task.arrays)
    assert memory.parameter_bytes(spec) == held


def test_the_limit_can_be_set_higher_and_lower(monkeypatch):
    spec = SMESpec(state_dim=100, action_dim=100)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "0.0001")
    with pytest.raises(ResourceLimitError, match=r"the limit is 0\.0001 GiB"):
        materialize(spec)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "0.01")
    assert materialize(spec).W.shape == (100, 100)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "16")
    assert memory.limit_bytes() == 16 * 2**30
    monkeypatch.delenv("SME_MEMORY_LIMIT_GIB")
    assert memory.limit_bytes() == 4 * 2**30


def test_a_limit_that_is_no_positive_number_is_refused(monkeypatch):
    for text in ("", "0", "-1", "nan", "1e300", "4 GiB"):
        monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", text)
        with pytest.raises(OptionError, match=f"_GIB={text!r}: must be a positive number of GiB"):
            materialize(SMESpec())
