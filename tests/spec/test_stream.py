"""Streams: what is valid, what is equal, which segment is in force, and files of streams."""

import copy
import json
import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sme_registry
from sme_registry.errors import (
    DigestMismatchError,
    FingerprintMismatchError,
    OptionError,
    ResourceLimitError,
    SMEError,
    SpecError,
    StreamError,
    UnknownNameError,
)
from sme_registry.spec import SMESpec, StreamSpec, cards
from sme_registry.spec.sme_spec import NEVER
from sme_registry.task import materialize
from sme_registry.task.loading import materialize_segments

SMALL = {"state_dim": 4, "action_dim": 2}
DRIFT = {"rotation": 1.0, "increments": 4}


def stream(*phases, **fields):
    return StreamSpec.from_dict({"phases": list(phases), **fields})


def phase(steps, drift=None, **spec):
    return {"spec": SMALL | spec, "steps": steps, **({"drift": drift} if drift else {})}


@st.composite
def streams(draw):
    phases = [
        phase(
            draw(st.integers(4, 50)),
            draw(st.none() | st.just(DRIFT) | st.just({"rotation": 2 * math.pi, "increments": 3})),
            seed=draw(st.integers(0, 3)),
            k=draw(st.integers(1, 5)),
        )
        for _ in range(draw(st.integers(1, 4)))
    ]
    return stream(
        *phases,
        cycles=draw(st.integers(1, 3)),
        switch=draw(st.sampled_from(["episode", "step"])),
        observes_phase=draw(st.booleans()),
    )


@given(streams(), streams())
def test_streams_are_equal_exactly_where_their_digests_are(one, other):
    assert (one == other) == (one.digest == other.digest)
    for twin in (
        StreamSpec.from_dict(json.loads(one.canonical_json())),
        pickle.loads(pickle.dumps(one)),
        copy.deepcopy(one),
        one.named("other"),
    ):
        assert twin == one
        assert hash(twin) == hash(one)
        assert twin.segments == one.segments


@given(streams(), st.data())
def test_the_segment_in_force_is_the_one_whose_steps_include_the_lifetime(spec, data):
    in_force = [
        index
        for index, (segment, after) in enumerate(
            pairwise([*spec.segments, spec.segments[-1]._replace(start=spec.cycle_steps)])
        )
        for _ in range(after.start - segment.start)
    ] * spec.cycles
    assert len(in_force) == spec.steps
    lifetime = data.draw(st.integers(0, spec.steps + 10))
    expected = in_force[lifetime] if lifetime < spec.steps else len(spec.segments) - 1
    assert spec.times.segment_at(lifetime) == expected
    switch = spec.times.next_switch(lifetime)
    later = range(lifetime + 1, spec.steps)
    boundaries = [i for i in later if (i % spec.cycle_steps) in {p.start for p in spec.segments}]
    assert switch == (boundaries[0] if boundaries else NEVER)


@given(streams())
def test_visits_end_where_their_phases_do(spec):
    ends = [end for _, end in spec.visit_ends()]
    assert [visit for visit, _ in spec.visit_ends()] == [*range(spec.visits)]
    for visit, (begin, end) in enumerate(pairwise([0, *ends])):
        for lifetime in (begin, end - 1):
            assert spec.segments[spec.times.segment_at(lifetime)].phase == visit % len(spec.phases)
    assert ends[-1] == spec.steps


@given(streams(), st.integers(0, 5))
def test_the_draws_of_a_stream_are_one_family(spec, number):
    drawn = spec.draw(number)
    assert drawn.family == spec.family
    assert (drawn == spec) == (number == 0)
    assert drawn.draw(1) == spec.draw(number + 1)
    both = zip(spec.phases, drawn.phases, strict=True)
    assert {other.spec.seed - one.spec.seed for one, other in both} == {number * 10**6}
    assert stream(phase(9), phase(9, seed=2)).family != stream(phase(9), phase(9, seed=1)).family


def test_a_number_of_no_draw_is_refused():
    for number in (-1, True, 1.0, "2", 2**32):
        with pytest.raises(OptionError, match=r"number=.*: must be an integer in \[0, 4,294,967,"):
            stream(phase(9)).draw(number)


def test_a_drift_is_short_phases_in_equal_increments_of_the_angle():
    spec = stream(phase(10), phase(102, {"rotation": 2 * math.pi, "increments": 4}, rotation=1.0))
    one, *drifting = spec.segments
    assert (one.phase, one.start, one.spec.rotation) == (0, 0, 0.0)
    assert [segment.start for segment in drifting] == [10, 35, 61, 86]
    angles = [segment.spec.rotation for segment in drifting]
    np.testing.assert_allclose(angles, 1.0 + np.arange(4) / 4 * (2 * math.pi - 1.0), rtol=1e-15)
    assert drifting[0].spec == spec.phases[1].spec
    over = stream(phase(4, {"rotation": 0.0, "increments": 4}, rotation=6.0))
    assert all(0 <= segment.spec.rotation < 2 * math.pi for segment in over.segments)


ZEROS = "sha256:" + "0" * 64


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([], "phases=[]: must have at least 1 item, not 0. Correct it."),
        ([phase(0)], "phases.0.steps=0: must be in [1"),
        ({"phases": [phase(1)], "cycles": 0}, "cycles=0"),
        ([phase(1), {"spec": "Defult", "steps": 1}], "phases.1.spec='Defult'"),
        ([phase(1), phase(1), phase(1, state_dim=5)], "phases.0 and phases.2: their specs have st"),
        ([phase(1), phase(1, action_dim=3)], "action_dim=2 and 3"),
        ([phase(1), phase(1, horizon=9)], "horizon=100 and 9"),
        ([phase(1, rotation=7.0)], "phases.0.spec.rotation=7.0: must be in"),
        ([phase(9, DRIFT, state_dim=1)], "phases.0.drift: rotation=1.0: must be 0, because a rot"),
        ([phase(3, DRIFT)], "phases.0.drift.increments=4: must be at most steps=3"),
        ([phase(9, {**DRIFT, "rotation": 0.0})], "phases.0.drift.rotation=0.0: is the angle of"),
        ([phase(9, {**DRIFT, "rotation": 6.3})], "phases.0.drift.rotation=6.3: must be in"),
        ([{"spec": "Team2", "steps": 1}], "phases.0.spec: is for a team of 2"),
        ([phase(1), {**phase(1), "digest": ZEROS}], "phases.1.digest='sha256:000"),
        ([{"digest": ZEROS, "steps": 1}], "phases.0.spec='sha256:000"),
        ([{**phase(1), "stps": 1}], "phases.0.stps=1: unknown field. Did you mean"),
        ({"phases": [phase(1)], "swich": "step"}, "swich='step': unknown field. Did you mean"),
        ([phase(20_000, {"rotation": 1.0, "increments": 9_999})] * 2, "19,998 segments"),
    ],
)
def test_a_bad_stream_is_refused_with_the_phase_that_is_wrong(fields, message):
    with pytest.raises(SpecError) as error:
        StreamSpec.from_dict({"phases": fields} if isinstance(fields, list) else fields)
    assert message in str(error.value)


def test_a_phase_is_given_in_full_by_name_or_by_digest():
    default = SMESpec()
    spec = stream(
        {"spec": "Default", "steps": 1},
        {"spec": default, "steps": 2},
        {"spec": default.digest, "steps": 3},
        {"digest": default.digest, "steps": 4},
        {"spec": default.to_dict(), "digest": default.digest, "steps": 5},
    )
    assert {each.spec for each in spec.phases} == {default}
    assert {each.digest for each in spec.phases} == {default.digest}
    assert json.loads(spec.canonical_json())["phases"][0]["spec"] == default.to_dict()


def test_a_stream_is_saved_whole_and_loaded_by_path_name_and_content(tmp_path):
    spec = stream(phase(10, seed=1), phase(20, DRIFT), cycles=2)
    path = sme_registry.save(spec, tmp_path / "mine.json", description="two phases")
    loaded = sme_registry.load(path)
    assert loaded == spec
    assert loaded.name == "mine"
    released = sme_registry.load("SME/Switch5-v1", StreamSpec)
    for name in ("Switch5", "SME/StreamSwitch5-v1", released.digest, released.content_name):
        assert sme_registry.load(name) == released
    with pytest.raises(UnknownNameError, match="Did you mean 'Switch5-v1'"):
        sme_registry.load("Swich5")
    with pytest.raises(StreamError, match="is a stream"):
        sme_registry.load("Switch5", SMESpec)


def test_a_changed_file_is_refused_with_the_phase_that_differs(tmp_path):
    path = sme_registry.save(stream(phase(10, seed=1), phase(20)), tmp_path / "mine.json")
    original = path.read_text()
    first = json.loads(original)["fingerprints"][0]
    for change, error, message in [
        (lambda file: file["stream"]["phases"][1]["spec"].update(k=2), SMEError, "phases.1.digest"),
        (lambda file: file["stream"].update(cycles=2), DigestMismatchError, "digest"),
        (
            lambda file: file["fingerprints"][1].update(optimal_action=first["optimal_action"]),
            FingerprintMismatchError,
            "phases.1: fingerprint.optimal_action",
        ),
        (lambda file: file.update(fingerprints=[first]), SpecError, "one for each of the 2 phases"),
    ]:
        changed = json.loads(original)
        change(changed)
        path.write_text(json.dumps(changed))
        with pytest.raises(error, match=message):
            sme_registry.load(path)


def test_segments_of_equal_specs_share_a_task_and_all_must_fit_in_memory_together(monkeypatch):
    one, two, again = materialize_segments(
        stream(phase(5, seed=1), phase(5, seed=2), phase(5, seed=1))
    )
    assert one is again
    assert one.spec != two.spec
    np.testing.assert_array_equal(one.W, materialize(one.spec).W)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "0.001")
    assert len(materialize_segments(stream(phase(1, complexity=3)))) == 1
    with pytest.raises(ResourceLimitError, match="40 different tasks together"):
        materialize_segments(stream(*(phase(1, seed=seed, complexity=3) for seed in range(40))))


def test_a_phase_without_a_block_of_the_one_before_says_what_it_dropped():
    shaped = SMESpec(shaping={"scale": 3.0})
    assert cards.changed_fields(shaped) == {"shaping.scale": 3.0}
    assert cards.in_words(cards.changed_fields(SMESpec(), shaped)) == "shaping.scale=none"
