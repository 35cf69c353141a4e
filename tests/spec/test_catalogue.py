"""The catalogue under `specs/`: each file is read, drawn, checked against its fingerprint, stepped.

Released names never change: `tests/golden/digests.json` holds the digest of each. After adding a
file run `python -m tests.golden.regenerate`, which adds it and refuses to change the others.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import sme_registry
from sme_registry.spec import (
    EnvFile,
    EvaluationProtocol,
    ProtocolFile,
    SMESpec,
    StreamFile,
    StudyFile,
    StudyPlan,
    Suite,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.resolve import ResolvedSpec, resolve
from sme_registry.task import materialize
from sme_registry.task.certify_observation import observation_checks
from sme_registry.task.certify_safety import safety_checks

ENVS, SUITES = catalogue.entries(EnvFile), catalogue.entries(SuiteFile)
PROTOCOLS = catalogue.entries(ProtocolFile)
RELEASED = json.loads((Path(__file__).parents[1] / "golden" / "digests.json").read_text())
NEW_AXES = [file for file in ENVS if file.spec.safety or file.spec.observation]
WITHOUT = [file for file in ENVS if file not in NEW_AXES]
KINDS = (EnvFile, SuiteFile, ProtocolFile, StudyFile)
EVERY_FILE = [(kind, path) for kind in KINDS for path in catalogue.paths(kind)]


JSON_TYPES = {
    "object": dict,
    "array": list,
    "string": str,
    "integer": int,
    "boolean": bool,
    "null": type(None),
}
CHECKS = {
    "const": lambda value, limit: value == limit,
    "enum": lambda value, limit: value in limit,
    "minimum": lambda value, limit: value >= limit,
    "maximum": lambda value, limit: value <= limit,
    "exclusiveMinimum": lambda value, limit: value > limit,
    "exclusiveMaximum": lambda value, limit: value < limit,
    "minLength": lambda value, limit: len(value) >= limit,
    "maxLength": lambda value, limit: len(value) <= limit,
    "minItems": lambda value, limit: len(value) >= limit,
    "maxItems": lambda value, limit: len(value) <= limit,
    "pattern": lambda value, limit: re.search(limit, value),
    "required": lambda value, limit: set(limit) <= set(value),
    "additionalProperties": lambda value, limit: limit is False,
    "type": lambda value, limit: (
        isinstance(value, JSON_TYPES.get(limit, int | float))
        and isinstance(value, bool) == (limit == "boolean")
    ),
}
NOTES = {"$comment", "title", "description", "default", "$defs"}


def follow(schema, value, definitions):
    """Assert that a value follows a JSON Schema; knows the words that ours use, and no others."""
    for word, limit in sorted(schema.items(), key=lambda item: item[0] != "type"):
        if word == "$ref":
            follow(definitions[limit.removeprefix("#/$defs/")], value, definitions)
        elif word == "anyOf":
            assert any(follows(choice, value, definitions) for choice in limit)
        elif word == "properties":
            assert set(value) <= set(limit)
            for name, entry in value.items():
                follow(limit[name], entry, definitions)
        elif word == "items":
            for entry in value:
                follow(limit, entry, definitions)
        elif word == "additionalProperties" and limit is not False:
            for entry in value.values():
                follow(limit, entry, definitions)
        elif word not in NOTES:
            assert CHECKS[word](value, limit), (word, limit, value)


def follows(schema, value, definitions):
    try:
        follow(schema, value, definitions)
    except AssertionError:
        return False
    return True


def ids(files):
    return [file.versioned_name for file in files]


def test_the_catalogue_has_the_tasks_that_the_design_names():
    families = {
        "Default": [""], "StateDim": [2, 4, 16, 32, 64], "ActionDim": [1, 2, 8, 16],
        "Interval": [5, 10, 25, 100], "MinReward": [25, 50, 75], "Survival": [10, 25, 50],
        "Complexity": [2, 3, 5, 10, 20, 50], "Plane": [1, 10, 50], "Team": [2, 4, 8],
        "TeamShared": [2, 4, 8], "Safety": ["05", 10, 20, 40],
        "Distract": ["8Noise", "32Noise", "32Autonomous", "32Driven"],
        "Mixed": ["Linear", "Nonlinear1", "Nonlinear3"], "HardSafeMixed": [""],
    }  # fmt: skip
    expected = {f"{family}{value}" for family, values in families.items() for value in values}
    assert expected <= {file.name for file in ENVS}
    suites = {"smoke", "paper-ablations", "core", "teams", "safety", "representation"}
    assert suites <= {file.name for file in SUITES}
    assert "paper" in {file.name for file in PROTOCOLS}


@pytest.mark.parametrize(("kind", "path"), EVERY_FILE, ids=[path.stem for _, path in EVERY_FILE])
def test_a_file_goes_by_its_name_and_its_digest_is_its_documents(kind, path):
    file = kind.read(path)
    assert path.stem == file.versioned_name
    assert file.digest == getattr(file, kind.content).digest
    assert file.description
    assert file.to_dict() == json.loads(path.read_text())


@pytest.mark.parametrize(("kind", "path"), EVERY_FILE, ids=[path.stem for _, path in EVERY_FILE])
def test_a_file_follows_the_exported_json_schema(kind, path):
    schema = kind.model_json_schema()
    follow(schema, json.loads(path.read_text()), schema.get("$defs", {}))


@pytest.mark.parametrize("document", [SMESpec, Suite, EvaluationProtocol, StudyPlan])
def test_the_exported_json_schema_states_fields_ranges_and_closes_the_object(document):
    schema = document.model_json_schema()
    assert set(schema["properties"]) == set(document.model_fields)
    assert schema["additionalProperties"] is False
    json.dumps(schema)


def test_the_schema_of_a_spec_states_what_is_refused_elsewhere():
    fields = SMESpec.model_json_schema()["properties"]
    assert (fields["state_dim"]["minimum"], fields["state_dim"]["maximum"]) == (1, 2**20)
    assert (fields["r_min"]["minimum"], fields["r_min"]["exclusiveMaximum"]) == (0, 1)
    assert fields["schema_version"]["const"] == 1
    assert fields["policy_init"]["enum"] == ["semi_orthogonal", "unit_variance"]
    for bad in (
        {"k": 0},
        {"k": "1"},
        {"r_min": 1},
        {"D": -1},
        {"seed": -1},
        {"seed": "7"},
        {"kk": 1},
    ):
        schema = SMESpec.model_json_schema()
        assert follows(schema, SMESpec().to_dict(), schema["$defs"])
        assert not follows(schema, SMESpec().to_dict() | bad, schema["$defs"])
    definitions = SMESpec.model_json_schema()["$defs"]
    tightness = definitions["SafetySpec"]["properties"]["tightness"]
    assert (tightness["exclusiveMinimum"], tightness["maximum"]) == (0, 0.5)
    observation = definitions["ObservationSpec"]["properties"]
    assert observation["distractors"]["minimum"] == 0
    assert observation["mixing"]["enum"] == ["none", "orthogonal", "nonlinear"]
    depth = observation["mixing_depth"]["anyOf"][0]
    assert (depth["minimum"], depth["maximum"]) == (1, 3)
    for name in ("safety", "observation"):
        assert follows(schema, SMESpec().to_dict() | {name: None}, schema["$defs"])
    for good, bad in (
        ({"safety": {"tightness": 0.5}}, {"safety": {"tightness": 0.0}}),
        ({"observation": {"distractors": 2, "dynamics": "driven"}}, {"observation": {"m": 2}}),
        ({"observation": {"mixing": "orthogonal"}}, {"observation": {"mixing": "linear"}}),
        ({"observation": {"mixing_depth": 3}}, {"observation": {"mixing_depth": 4}}),
    ):
        assert follows(schema, SMESpec().to_dict() | good, schema["$defs"])
        assert not follows(schema, SMESpec().to_dict() | bad, schema["$defs"])
    assert fields["seed"]["anyOf"][1]["pattern"] == "^0x[0-9a-fA-F]{1,64}$"


def published(file):
    """The task of a file, found by its name and with its published numbers."""
    assert resolve(file.versioned_name) == ResolvedSpec(file.spec, file.fingerprint)
    task = materialize(file.spec, file.fingerprint)
    assert task.W.shape == (file.spec.action_dim, file.spec.state_dim)
    return task


@pytest.mark.parametrize("file", WITHOUT, ids=ids(WITHOUT))
def test_a_task_is_drawn_with_its_published_numbers_and_stepped(file):
    spec, task = file.spec, published(file)
    env = sme_registry.make_parallel(file.versioned_name)
    assert env.sme_spec == spec
    _, infos = env.reset(seed=1)
    assert tuple(infos) == task.names
    s = env.state()
    a = task.optimal_action(s)
    actions = {name: a[own] for name, own in zip(task.names, task.owned, strict=True)}
    observations, _, terminated, _, infos = env.step(actions)
    np.testing.assert_array_equal(env.state(), task.transition(s, a))
    for name, channels in zip(task.names, task.observed, strict=True):
        assert infos[name]["regret"] < 1e-12
        assert not terminated[name]
        seen = env.state()[list(channels)].astype(np.float32)
        np.testing.assert_array_equal(observations[name][:-2], seen)
    env.close()


@pytest.mark.parametrize("file", NEW_AXES, ids=ids(NEW_AXES))
def test_a_task_with_limits_or_an_observation_is_stepped_with_its_published_numbers(file):
    task, env = published(file), sme_registry.make(file.versioned_name)
    assert env.unwrapped.sme_spec == file.spec
    assert env.observation_space.shape == (file.spec.observation_dim,)
    env.reset(seed=1)
    s = env.unwrapped.state
    observation, _, _, _, info = env.step(task.safe_action(s).astype(np.float32))
    np.testing.assert_array_equal(env.unwrapped.state, task.transition(s, task.safe_action(s)))
    seen = task.seen(env.unwrapped.state, env.unwrapped.distractors)
    np.testing.assert_allclose(observation[:-2], seen, rtol=0, atol=1e-6)
    if file.spec.safety is not None:
        np.testing.assert_allclose(info["limit"], task.limit(s), rtol=0, atol=1e-12)
        assert info["cost"] < 1e-6  # the safe action, rounded to float32
        assert abs(info["safe_regret"]) < 1e-6
    env.close()


@pytest.mark.parametrize("file", SUITES, ids=ids(SUITES))
def test_a_suites_instances_are_distinct_tasks_that_can_be_drawn(file):
    instances = file.suite.instances
    assert len(instances) == sum(len(member.seeds) for member in file.suite.classes)
    assert len({spec.digest for spec in instances}) == len(instances)
    for member in file.suite.classes:
        first = member.instances[0]
        assert first == SMESpec.from_dict({**member.setting.to_dict(), "seed": member.seeds[0]})
        materialize(first)


def test_suites_have_the_sizes_that_the_design_states():
    by_name = {file.name: [len(m.seeds) for m in file.suite.classes] for file in SUITES}
    assert by_name["smoke"] == [2, 2, 2]
    assert by_name["core"] == [10] * 6


def test_the_suites_of_safety_and_observation_change_one_axis_of_the_default():
    by_name = {file.name: file.suite for file in SUITES}
    for name, axis in (("safety", "safety"), ("representation", "observation")):
        plain, *others = by_name[name].classes
        assert getattr(plain.setting, axis) is None
        for member in others:
            assert getattr(member.setting, axis) is not None
            changed = member.setting.to_dict()
            del changed[axis]
            depth = {"complexity": member.setting.complexity} if member.name == "deep" else {}
            assert changed == plain.setting.to_dict() | depth
        assert {len(member.seeds) for member in by_name[name].classes} == {10}


@pytest.mark.parametrize("file", NEW_AXES, ids=ids(NEW_AXES))
def test_tasks_with_safety_or_observation_are_the_default_otherwise_and_certified(file):
    init = "unit_variance" if file.spec.safety else "semi_orthogonal"
    assert file.spec.derive(safety=None, observation=None) == SMESpec(policy_init=init)
    task = materialize(file.spec)
    checks = (*safety_checks(task, 0, 4_000), *observation_checks(task, 0, 4_000))
    assert {check.outcome for check in checks} <= {"passed", "reported"}


def test_core_uses_unit_variance_where_layers_widen():
    core = next(file.suite for file in SUITES if file.name == "core")
    for member in core.classes:
        setting = member.setting
        if setting.complexity > 1 and setting.state_dim < setting.hidden_width:
            assert setting.policy_init == "unit_variance"
    assert sum(member.setting.complexity >= 10 for member in core.classes) >= 3


def test_a_released_name_never_changes_its_digest():
    assert set(RELEASED) == {kind.content for kind in (*KINDS, StreamFile)}
    for kind in (*KINDS, StreamFile):
        for file in catalogue.entries(kind):
            assert RELEASED[file.content][file.versioned_name] == file.digest
        assert sorted(RELEASED[kind.content]) == sorted(catalogue.names(kind))


def test_no_two_tasks_of_the_catalogue_are_the_same():
    assert len({file.digest for file in ENVS}) == len(ENVS)
    assert len({file.spec.content_name for file in ENVS}) == len(ENVS)


def test_names_come_in_natural_order_and_can_be_used_by_every_registry():
    names = catalogue.names(EnvFile)
    assert names.index("StateDim4-v1") < names.index("StateDim16-v1")
    for name in names:
        assert re.fullmatch(r"[-_\w]+-v1", name)


def test_names_by_content_are_read_without_validation_but_are_right():
    tasks = [
        ("team" if file.spec.team else "spec", file.versioned_name, file.spec.content_name)
        for file in ENVS
    ]
    streams = [
        ("stream", file.versioned_name, file.stream.content_name)
        for file in catalogue.entries(StreamFile)
    ]
    assert list(catalogue.released()) == tasks + streams
