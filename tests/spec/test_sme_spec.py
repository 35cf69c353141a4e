"""Identity of specs: what is equal, what is hashed, what a spec can be written as."""

import copy
import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sme_registry.errors import SpecError
from sme_registry.io import parse_json
from sme_registry.spec import (
    AgentSpec,
    ObservationSpec,
    SafetySpec,
    SMESpec,
    Suite,
    SuiteClass,
    TeamSpec,
)
from tests.strategies import SEEDS, THRESHOLDS, spec_fields, specs

# One other valid value for every field of a single-agent spec.
CHANGED = {
    "state_dim": 9,
    "action_dim": 5,
    "k": 2,
    "r_min": 0.5,
    "D": 0.5,
    "complexity": 2,
    "horizon": 101,
    "hidden_width": 65,
    "policy_init": "unit_variance",
    "rotation": 0.5,
    "team": {"agents": [{"action_dim": 4}]},
    "safety": {"tightness": 0.2},
    "observation": {"distractors": 8},
    "seed": 1,
}

SAFE = "sha256:9b2f25e58ca2bdc6e04840144f1cf098789b4c08bbda38c8ad3d44afedc228b9"
OBSERVED = "sha256:b53edb2f3d2bf66a71d61c5bbad25f3ae4293ca3efc7995538b147804f2d9654"


@given(specs(), specs())
def test_specs_are_equal_exactly_where_their_digests_are(one, other):
    assert (one == other) == (one.digest == other.digest)
    if one == other:
        assert hash(one) == hash(other)


@given(spec_fields(), st.data())
def test_a_spec_differs_from_itself_with_any_one_field_changed(fields, data):
    spec = SMESpec.from_dict(fields)
    field = data.draw(st.sampled_from(["k", "r_min", "D", "complexity", "horizon", "seed"]))
    value = data.draw(
        {"seed": SEEDS, "r_min": THRESHOLDS, "D": THRESHOLDS}.get(field, st.integers(1, 10))
    )
    derived = spec.derive(**{field: value})
    same = getattr(derived, field) == getattr(spec, field)
    assert (derived.digest == spec.digest) is same
    assert (derived == spec) is same


def test_every_field_but_the_version_of_the_schema_is_part_of_the_digest():
    assert CHANGED.keys() == SMESpec.model_fields.keys() - {"schema_version"}
    digests = {SMESpec().digest} | {SMESpec().derive(**{f: v}).digest for f, v in CHANGED.items()}
    assert len(digests) == 1 + len(CHANGED)
    in_json = set(SMESpec.model_fields) - {"rotation", "safety", "observation"}
    assert set(json.loads(SMESpec().canonical_json())) == in_json
    rotated = SMESpec(rotation=0.5)
    assert set(json.loads(rotated.canonical_json())) == in_json | {"rotation"}
    assert rotated.digest.startswith("sha256:130c1352935c1883")  # as released
    assert rotated.derive(rotation=0.0) == SMESpec() == SMESpec(rotation=-0.0)


def test_older_documents_have_the_bytes_that_they_had_before_safety_and_observation():
    for spec in (SMESpec(), SMESpec(rotation=0.5), SMESpec(team={"agents": [{"action_dim": 4}]})):
        named = SMESpec.from_dict(spec.to_dict() | {"safety": None, "observation": None})
        assert named == spec
        assert named.canonical_json() == spec.canonical_json()
        assert b"safety" not in spec.canonical_json()
        assert b"observation" not in spec.canonical_json()


@pytest.mark.parametrize(
    ("short", "full"),
    [
        (
            {"distractors": 8},
            {"distractors": 8, "dynamics": "noise", "mixing": "none", "mixing_depth": None},
        ),
        (
            {"mixing": "nonlinear"},
            {"distractors": 0, "dynamics": None, "mixing": "nonlinear", "mixing_depth": 1},
        ),
        (
            {"mixing": "orthogonal"},
            {"distractors": 0, "dynamics": None, "mixing": "orthogonal", "mixing_depth": None},
        ),
    ],
)
def test_a_default_of_observation_is_written_out_so_that_one_observation_is_one_document(
    short, full
):
    spec = SMESpec(observation=short)
    assert spec.to_dict()["observation"] == full
    assert spec == SMESpec(observation=full)
    assert spec.digest == SMESpec(observation=full).digest
    assert SMESpec(observation=ObservationSpec(**short)) == spec
    assert spec.derive(observation=None) == SMESpec()


def test_the_digests_of_safety_and_observation_are_those_of_the_first_release():
    assert SMESpec(safety={"tightness": 0.2}).digest == SAFE
    assert SMESpec(safety=SafetySpec(tightness=0.2)).digest == SAFE
    observation = {"distractors": 32, "dynamics": "driven", "mixing": "nonlinear"}
    assert SMESpec(observation=observation).digest == OBSERVED


@given(specs())
def test_a_spec_survives_plain_data_json_pickling_and_copying(spec):
    assert SMESpec.from_dict(spec.to_dict()) == spec
    assert SMESpec.from_dict(parse_json(json.dumps(spec.to_dict()))) == spec
    assert SMESpec.from_dict(parse_json(spec.canonical_json())) == spec
    assert SMESpec(**spec.to_dict()) == spec
    for twin in (pickle.loads(pickle.dumps(spec)), copy.deepcopy(spec)):
        assert twin == spec
        assert twin.digest == spec.digest


@given(spec_fields(), st.randoms(use_true_random=False))
def test_the_digest_ignores_the_order_of_keys(fields, random):
    keys = list(fields)
    random.shuffle(keys)
    assert (
        SMESpec.from_dict({key: fields[key] for key in keys}).digest
        == SMESpec.from_dict(fields).digest
    )


def test_a_field_at_its_default_is_the_same_spec_as_one_left_out():
    assert SMESpec(state_dim=8, D=0, team=None) == SMESpec()
    assert SMESpec(state_dim=8, D=0, team=None).digest == SMESpec().digest


@pytest.mark.parametrize("zero", [0, 0.0, -0.0, np.float64(-0.0), np.int8(0)])
def test_every_zero_is_one_zero(zero):
    spec = SMESpec(r_min=zero, D=zero)
    assert spec.digest == SMESpec().digest
    assert str(spec.r_min) == "0.0"
    assert "-0" not in json.dumps(spec.to_dict())


@pytest.mark.parametrize(
    ("field", "given_value", "kept"),
    [
        ("k", np.int16(3), 3),
        ("state_dim", np.uint8(5), 5),
        ("seed", np.int64(7), 7),
        ("r_min", np.float64(0.5), 0.5),
        ("r_min", np.float32(0.5), 0.5),
        ("D", np.int64(0), 0.0),
        ("k", np.array(3), 3),
    ],
)
def test_numpy_scalars_are_taken_as_pythons(field, given_value, kept):
    value = getattr(SMESpec(**{field: given_value}), field)
    assert value == kept
    assert type(value) is type(kept)


@pytest.mark.parametrize(
    ("written", "kept"),
    [
        ("0xAB", "0xab"),
        ("0x00ab", "0xab"),
        ("0x0", "0x0"),
        ("0x000", "0x0"),
        ("0x" + "f" * 64, "0x" + "f" * 64),
    ],
)
def test_a_hexadecimal_seed_has_one_spelling(written, kept):
    assert SMESpec(seed=written).seed == kept
    assert SMESpec(seed=written).digest == SMESpec(seed=kept).digest


def test_a_hexadecimal_seed_is_another_seed_than_the_integer():
    assert SMESpec(seed="0x10") != SMESpec(seed=16)


def test_specs_are_frozen_and_hashable():
    spec = SMESpec()
    with pytest.raises(ValidationError, match="frozen"):
        spec.k = 2
    assert {spec: "found"}[SMESpec()] == "found"


def test_deriving_with_nothing_gives_the_same_spec():
    assert SMESpec(k=3).derive() == SMESpec(k=3)


def test_the_name_by_content_begins_the_digest():
    spec = SMESpec()
    assert spec.content_name == f"sha256-{spec.digest[7:19]}"


class TestTeams:
    def test_agents_without_a_name_are_numbered_from_zero(self):
        team = TeamSpec(
            agents=[{"action_dim": 1}, {"action_dim": 1, "name": "pilot_7"}, {"action_dim": 1}]
        )
        assert [agent.name for agent in team.agents] == ["agent_0", "pilot_7", "agent_2"]

    def test_observing_all_is_the_same_team_as_listing_every_channel(self):
        listed = {"agents": [{"action_dim": 4, "observes": list(range(8))}]}
        everything = {"agents": [{"action_dim": 4, "observes": "all"}]}
        left_out = {"agents": [{"action_dim": 4}]}
        specs = [SMESpec(team=team) for team in (listed, everything, left_out)]
        assert len(set(specs)) == 1
        assert len({spec.digest for spec in specs}) == 1
        assert specs[0].to_dict()["team"]["agents"][0]["observes"] == "all"

    def test_a_part_of_the_channels_is_another_team(self):
        part = SMESpec(team={"agents": [{"action_dim": 4, "observes": list(range(7))}]})
        assert part != SMESpec(team={"agents": [{"action_dim": 4}]})
        assert part.to_dict()["team"]["agents"][0]["observes"] == list(range(7))

    def test_nested_blocks_may_be_models_dicts_lists_or_tuples(self):
        agent = AgentSpec(name="agent_0", action_dim=4, observes=(0, np.int64(2)))
        ways = [
            SMESpec(team=TeamSpec(agents=(agent,))),
            SMESpec(team={"agents": [agent]}),
            SMESpec(team={"agents": ({"action_dim": np.int64(4), "observes": [0, 2]},)}),
        ]
        assert len({spec.digest for spec in ways}) == 1

    @given(specs(team=True))
    def test_the_agents_own_all_action_channels(self, spec):
        assert sum(agent.action_dim for agent in spec.team.agents) == spec.action_dim


class TestSuites:
    def test_the_instances_of_a_class_are_its_setting_under_each_seed(self):
        member = SuiteClass(name="deep", setting={"complexity": 10}, seeds=[3, "0x2"])
        assert member.instances == (
            SMESpec(complexity=10, seed=3),
            SMESpec(complexity=10, seed="0x2"),
        )

    def test_a_setting_with_a_seed_is_refused_as_it_would_be_lost(self):
        with pytest.raises(SpecError, match=r"setting\.seed=3"):
            SuiteClass(name="deep", setting=SMESpec(seed=3), seeds=[1])

    def test_suites_are_equal_exactly_where_their_digests_are(self):
        one = Suite(classes=[{"name": "a", "setting": {}, "seeds": [1, 2]}])
        same = Suite(classes=[{"name": "a", "setting": {"D": -0.0}, "seeds": (1, 2)}])
        other = Suite(classes=[{"name": "a", "setting": {}, "seeds": [2, 1]}])
        assert one == same
        assert one.digest == same.digest
        assert one != other
        assert one.digest != other.digest


def test_lists_of_wrong_entries_are_not_also_called_too_short():
    with pytest.raises(SpecError) as caught:
        SMESpec.from_dict({"team": {"agents": [{"action_dim": 0}]}})
    assert len(str(caught.value).splitlines()) == 1
