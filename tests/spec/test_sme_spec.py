"""Identity of specs: what is equal, what is hashed, what a spec can be written as."""

import copy
import hashlib
import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import rfc8785
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from sme_registry.errors import SpecError
from sme_registry.io import parse_json
from sme_registry.spec import (
    AgentSpec,
    ObservationSpec,
    SafetySpec,
    SMESpec,
    SuiteClass,
    TeamSpec,
)
from tests.strategies import spec_fields, specs

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
    "shaping": {"scale": 3.0},
    "noise": {"reward": 0.3},
    "seed": 1,
}

SAFE = "sha256:9b2f25e58ca2bdc6e04840144f1cf098789b4c08bbda38c8ad3d44afedc228b9"
OBSERVED = "sha256:b53edb2f3d2bf66a71d61c5bbad25f3ae4293ca3efc7995538b147804f2d9654"


@given(specs(), specs())
def test_specs_are_equal_exactly_where_their_digests_are(one, other):
    assert (one == other) == (one.digest == other.digest)
    assert one.content_name == f"sha256-{one.digest[7:19]}"
    assert {one: "found"}[SMESpec.from_dict(one.to_dict())] == "found"
    with pytest.raises(ValidationError, match="frozen"):
        one.k = 2


def test_every_field_but_the_version_of_the_schema_is_part_of_the_digest():
    assert CHANGED.keys() == SMESpec.model_fields.keys() - {"schema_version"}
    digests = {SMESpec().digest} | {SMESpec().derive(**{f: v}).digest for f, v in CHANGED.items()}
    assert len(digests) == 1 + len(CHANGED)
    # Younger fields are left out at their defaults: older documents have the bytes that they had.
    young = {"rotation", "safety", "observation", "shaping", "noise"}
    for fields in ({}, {"rotation": 0.5}, {"team": CHANGED["team"]}):
        spec = SMESpec(**fields)
        expected = SMESpec.model_fields.keys() - young | fields.keys()
        assert json.loads(spec.canonical_json()).keys() == expected
        named = SMESpec.from_dict(spec.to_dict() | {"safety": None, "observation": None})
        assert named == spec
        assert named.canonical_json() == spec.canonical_json()
    rotated = SMESpec(rotation=0.5)
    assert rotated.digest.startswith("sha256:130c1352935c1883")  # as released
    assert rotated.derive(rotation=0.0) == SMESpec() == SMESpec(rotation=-0.0)
    assert SMESpec(state_dim=8, D=0, team=None).digest == SMESpec().digest


def test_a_default_of_observation_is_written_out_so_that_one_observation_is_one_document():
    plain = {"distractors": 0, "dynamics": None, "mixing": "none", "mixing_depth": None}
    for short, chosen in (
        ({"distractors": 8}, {"distractors": 8, "dynamics": "noise"}),
        ({"mixing": "nonlinear"}, {"mixing": "nonlinear", "mixing_depth": 1}),
        ({"mixing": "orthogonal"}, {"mixing": "orthogonal"}),
    ):
        spec, full = SMESpec(observation=short), plain | chosen
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


@given(spec_fields(), st.randoms(use_true_random=False))
def test_a_spec_survives_plain_data_json_pickling_and_copying(fields, random):
    spec, keys = SMESpec.from_dict(fields), list(fields)
    random.shuffle(keys)
    for twin in (
        SMESpec.from_dict({key: fields[key] for key in keys}),
        SMESpec.from_dict(spec.to_dict()),
        SMESpec.from_dict(parse_json(json.dumps(spec.to_dict()))),
        SMESpec.from_dict(parse_json(spec.canonical_json())),
        SMESpec(**spec.to_dict()),
        spec.derive(),
        pickle.loads(pickle.dumps(spec)),
        copy.deepcopy(spec),
    ):
        assert twin == spec
        assert twin.digest == spec.digest


@pytest.mark.parametrize("zero", [0, 0.0, -0.0, np.float64(-0.0), np.int8(0)])
def test_every_zero_is_one_zero(zero):
    spec = SMESpec(r_min=zero, D=zero)
    assert spec.digest == SMESpec().digest
    assert str(spec.r_min) == "0.0"
    assert "-0" not in json.dumps(spec.to_dict())


def test_numpy_scalars_are_taken_as_pythons():
    for field, given_value, kept in (
        ("k", np.int16(3), 3),
        ("state_dim", np.uint8(5), 5),
        ("seed", np.int64(7), 7),
        ("r_min", np.float32(0.5), 0.5),
        ("D", np.int64(0), 0.0),
        ("k", np.array(3), 3),
    ):
        value = getattr(SMESpec(**{field: given_value}), field)
        assert value == kept
        assert type(value) is type(kept)


def test_a_hexadecimal_seed_has_one_spelling_and_is_not_the_integer():
    for written, kept in (("0xAB", "0xab"), ("0x00ab", "0xab"), ("0x000", "0x0")):
        assert SMESpec(seed=written).seed == kept
        assert SMESpec(seed=written).digest == SMESpec(seed=kept).digest
    assert SMESpec(seed="0x" + "f" * 64).seed == "0x" + "f" * 64
    assert SMESpec(seed="0x10") != SMESpec(seed=16)


class TestTeams:
    def test_agents_without_a_name_are_numbered_from_zero(self):
        team = TeamSpec(
            agents=[{"action_dim": 1}, {"action_dim": 1, "name": "pilot_7"}, {"action_dim": 1}]
        )
        assert [agent.name for agent in team.agents] == ["agent_0", "pilot_7", "agent_2"]

    def test_observing_all_is_the_same_team_as_listing_every_channel_but_not_a_part(self):
        listed = {"agents": [{"action_dim": 4, "observes": list(range(8))}]}
        everything = {"agents": [{"action_dim": 4, "observes": "all"}]}
        left_out = {"agents": [{"action_dim": 4}]}
        specs = [SMESpec(team=team) for team in (listed, everything, left_out)]
        assert len(set(specs)) == 1
        assert len({spec.digest for spec in specs}) == 1
        assert specs[0].to_dict()["team"]["agents"][0]["observes"] == "all"
        part = SMESpec(team={"agents": [{"action_dim": 4, "observes": list(range(7))}]})
        assert part != specs[0]
        assert part.to_dict()["team"]["agents"][0]["observes"] == list(range(7))

    def test_nested_blocks_may_be_models_dicts_lists_or_tuples(self):
        agent = AgentSpec(name="agent_0", action_dim=4, observes=(0, np.int64(2)))
        ways = [
            SMESpec(team=TeamSpec(agents=(agent,))),
            SMESpec(team={"agents": [agent]}),
            SMESpec(team={"agents": ({"action_dim": np.int64(4), "observes": [0, 2]},)}),
        ]
        assert len({spec.digest for spec in ways}) == 1


class TestSuites:
    def test_a_setting_with_a_seed_is_refused_as_it_would_be_lost(self):
        with pytest.raises(SpecError, match=r"setting\.seed=3"):
            SuiteClass(name="deep", setting=SMESpec(seed=3), seeds=[1])


VECTORS = Path(__file__).parent / "rfc8785"
NAMES = sorted(path.stem for path in (VECTORS / "input").glob("*.json"))


def test_published_documents_have_their_published_canonical_bytes():
    assert NAMES == ["arrays", "french", "structures", "unicode", "values", "weird"]
    for name in NAMES:
        given = (VECTORS / "input" / f"{name}.json").read_bytes()
        expected = (VECTORS / "output" / f"{name}.json").read_bytes()
        assert rfc8785.dumps(parse_json(given)) == expected


def test_the_guides_vectors_of_digests_follow_from_its_rule():
    """By a second implementation: the rule of docs/guides/tasks.md in a few lines."""
    guide = Path(__file__).parents[2] / "docs" / "guides" / "tasks.md"
    lines = re.findall(r'^(\{"D".*\})\n(sha256:[0-9a-f]{64})$', guide.read_text("utf-8"), re.M)
    blocks = ("safety", "observation", "shaping", "noise")
    later = {"rotation": 0, "compensated": False, "discount": 1, **dict.fromkeys(blocks)}

    def plain(value):
        if isinstance(value, BaseModel):
            fields = {name: getattr(value, name) for name in type(value).model_fields}
            return {k: plain(v) for k, v in fields.items() if k not in later or v != later[k]}
        return int(value) if isinstance(value, float) and value.is_integer() else value

    assert len(lines) == 3
    for text, digest in lines:
        spec = SMESpec.from_dict(json.loads(text))
        canonical = json.dumps(
            plain(spec), sort_keys=True, separators=(",", ":"), ensure_ascii=False
        )
        assert canonical == text
        assert "sha256:" + hashlib.sha256(canonical.encode()).hexdigest() == digest == spec.digest
