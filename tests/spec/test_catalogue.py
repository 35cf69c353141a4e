"""The catalogue under `specs/`: each file is read, drawn and checked against its fingerprint.

Released names never change: `tests/golden/digests.json` holds the digest of each. After adding a
file run `python -m tests.golden.regenerate`, which adds it and refuses to change the others.
"""

import json
import pickle
import re
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

import sme_registry
from sme_registry import EvaluationReport, evaluate, load, register, save
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


# --- Titles ---------------------------------------------------------------------------------------

OTHER = SMESpec(state_dim=2, action_dim=2, k=2, seed=5)
QUICK = {"states_per_region": 20, "epsilons": [0.5]}


@pytest.fixture
def named(tmp_path):
    return load(save(OTHER, tmp_path / "k2.json"))


def test_a_task_of_a_file_has_the_name_of_its_file(named):
    assert named.name == catalogue.title(named) == "k2"
    assert catalogue.title(pickle.loads(pickle.dumps(named))) == "k2"
    assert catalogue.title(OTHER) == f"SME/{OTHER.content_name}"
    assert catalogue.title(load("Default")) == "SME/Default-v1"


def test_a_name_is_no_part_of_a_spec(named):
    assert (named, hash(named), named.digest) == (OTHER, hash(OTHER), OTHER.digest)
    assert OTHER.name == ""
    assert named.to_dict() == OTHER.to_dict()
    assert named != OTHER.derive(k=3)
    assert named.derive(k=3).name == ""  # another task


def test_a_file_cannot_pose_as_a_task_of_the_catalogue(tmp_path):
    for name in ("Default", "Default-v1"):
        spec = load(save(OTHER, tmp_path / "mine.json", name=name, force=True))
        assert catalogue.title(spec) == f"{name} ({OTHER.content_name})"
    assert catalogue.title(load(save(SMESpec(), tmp_path / "ours.json"))) == "SME/Default-v1"
    assert catalogue.title(load(register(OTHER.derive(seed=6), "Mine"))) == "SME/Mine-v1"


def test_tasks_of_one_name_are_told_apart(named):
    twin = OTHER.derive(seed=7).named("k2")
    titles = catalogue.titles([named, SMESpec(), twin, named])
    assert titles == {
        OTHER.digest: f"k2 ({OTHER.content_name})",
        SMESpec().digest: "SME/Default-v1",
        twin.digest: f"k2 ({twin.content_name})",
    }


def test_a_report_keeps_the_name_in_its_file(tmp_path, named):
    report = evaluate("constant", named, QUICK)
    again = EvaluationReport.read(report.write(tmp_path / "evaluation.json"))
    assert report.title == again.title == "k2"
    assert str(again).startswith("constant on k2\n")
    assert "task" not in evaluate("constant", OTHER, QUICK).to_dict()


def test_no_document_fills_a_screen():
    for kind, name in ((SuiteFile, "core"), (StudyFile, "smoke"), (ProtocolFile, "paper")):
        assert len(repr(catalogue.find(kind, name))) < 400
    assert "agents=<tuple of 4>" in repr(sme_registry.load("Team4"))
    spec = SMESpec(complexity=5)
    assert eval(repr(spec)) == spec
    assert "k=5, r_min=0.123456789" in SMESpec(r_min=0.123456789, k=5)._repr_html_()


def test_a_notebook_shows_a_tasks_fields_name_and_digest():
    spec = SMESpec(complexity=5, k=3).named("<Mine>")
    html = spec._repr_html_()
    for text in ("complexity", "<b>5</b>\ndefault 1", spec.digest, "&lt;Mine&gt;"):
        assert text in html
    assert "<Mine>" not in html
    assert "Not the default: k=3, complexity=5" in html
    assert ">L</b>" in html  # its symbol
    assert "layers of the optimal policy" in html  # its meaning
    assert html.count("\ndefault ") == 2
    assert "safety" not in html  # not set
    stream = sme_registry.load("Switch5")._repr_html_()
    assert stream.count(">seed=") == 4
