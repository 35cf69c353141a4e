"""The catalogue under `specs/`: each file is read, drawn and checked against its fingerprint.

Released names never change: `tests/golden/digests.json` holds the digest of each. After adding a
file run `python -m tests.golden.regenerate`, which adds it and refuses to change the others.
"""

import json
import re
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

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


@pytest.mark.parametrize("file", ENVS, ids=ids(ENVS))
def test_a_task_is_found_by_its_name_and_drawn_with_its_published_numbers(file):
    assert resolve(file.versioned_name) == Resolved(file.spec, (file.fingerprint,))
    task = materialize(file.spec, file.fingerprint)
    assert task.W.shape == (file.spec.action_dim, file.spec.state_dim)


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
