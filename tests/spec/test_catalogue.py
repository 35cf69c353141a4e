"""The catalogue under `specs/`: each file is read, drawn, checked against its fingerprint, stepped.

Released names never change: `tests/golden/digests.json` holds the digest of each. After adding a
file run `python -m tests.golden.regenerate`, which adds it and refuses to change the others.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator

import sme_registry
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StreamFile,
    StudyFile,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.catalogue import resolve
from sme_registry.spec.files import Resolved
from sme_registry.task import materialize

ENVS, SUITES = catalogue.entries(EnvFile), catalogue.entries(SuiteFile)
RELEASED = json.loads((Path(__file__).parents[1] / "golden" / "digests.json").read_text())
NEW_AXES = [file for file in ENVS if file.spec.safety or file.spec.observation]
WITHOUT = [file for file in ENVS if file not in NEW_AXES]
KINDS = (EnvFile, SuiteFile, ProtocolFile, StudyFile)


def follows(schema, value):
    return Draft202012Validator(schema).is_valid(value)


def ids(files):
    return [file.versioned_name for file in files]


@pytest.mark.parametrize("kind", KINDS)
def test_files_go_by_their_names_have_their_documents_digests_and_follow_the_schema(kind):
    schema = kind.model_json_schema()
    for path in catalogue.paths(kind):
        file, plain = kind.read(path), json.loads(path.read_text())
        assert path.stem == file.versioned_name
        assert file.digest == getattr(file, kind.content).digest
        assert file.description
        assert file.to_dict() == plain
        assert follows(schema, plain)


def test_the_schema_of_a_spec_states_what_is_refused_elsewhere():
    schema = SMESpec.model_json_schema()
    fields = schema["properties"]
    assert (fields["state_dim"]["minimum"], fields["state_dim"]["maximum"]) == (1, 2**20)
    assert (fields["r_min"]["minimum"], fields["r_min"]["exclusiveMaximum"]) == (0, 1)
    assert fields["policy_init"]["enum"] == ["semi_orthogonal", "unit_variance"]
    assert fields["seed"]["anyOf"][1]["pattern"] == "^0x[0-9a-fA-F]{1,64}$"
    for good, bad in (
        ({}, {"schema_version": 2}),
        ({"k": 1}, {"k": 0}),
        ({"k": 2}, {"k": "1"}),
        ({"r_min": 0.5}, {"r_min": 1}),
        ({"D": 0.5}, {"D": -1}),
        ({"seed": "0x7"}, {"seed": "7"}),
        ({"seed": 0}, {"seed": -1}),
        ({"team": None}, {"kk": 1}),
        ({"safety": None}, {"safety": {"tightness": 0.0}}),
        ({"safety": {"tightness": 0.5}}, {"safety": {"tightness": 0.51}}),
        ({"observation": {"distractors": 2, "dynamics": "driven"}}, {"observation": {"m": 2}}),
        ({"observation": {"mixing": "orthogonal"}}, {"observation": {"mixing": "linear"}}),
        ({"observation": {"mixing_depth": 3}}, {"observation": {"mixing_depth": 4}}),
        ({"observation": {"distractors": 0}}, {"observation": {"distractors": -1}}),
    ):
        assert follows(schema, SMESpec().to_dict() | good), good
        assert not follows(schema, SMESpec().to_dict() | bad), bad


def published(file):
    """The task of a file, found by its name and with its published numbers."""
    assert resolve(file.versioned_name) == Resolved(file.spec, (file.fingerprint,))
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
    noisy = spec.noise is not None and spec.noise.transition > 0
    assert np.array_equal(env.state(), task.transition(s, a)) is not noisy
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
    """Which they are, and how many, is fixed by the digests of the suites."""
    instances = file.suite.instances
    assert len(instances) == sum(len(member.seeds) for member in file.suite.classes)
    assert len({spec.digest for spec in instances}) == len(instances)
    for member in file.suite.classes:
        first = member.instances[0]
        assert first == SMESpec.from_dict({**member.setting.to_dict(), "seed": member.seeds[0]})
        materialize(first)


def test_a_released_name_never_changes_its_digest():
    assert set(RELEASED) == {kind.content for kind in (*KINDS, StreamFile)}
    for kind in (*KINDS, StreamFile):
        entries = catalogue.entries(kind)
        assert RELEASED[kind.content] == {file.versioned_name: file.digest for file in entries}
        assert sorted(RELEASED[kind.content]) == sorted(catalogue.names(kind))
    assert len({file.digest for file in ENVS}) == len(ENVS)  # no two are the same


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
