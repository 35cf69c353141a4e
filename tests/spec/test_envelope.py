"""Files: what `save` writes, `load` reads; what was changed on the way is noticed."""

import json
from pathlib import Path

import gymnasium
import pytest
from hypothesis import HealthCheck, given, settings

import sme_registry
from sme_registry.errors import (
    DigestMismatchError,
    FingerprintMismatchError,
    OptionError,
    SpecError,
)
from sme_registry.spec import EnvFile, ProtocolFile, SMESpec, StudyFile, SuiteFile, catalogue
from sme_registry.spec.files import Fingerprint
from sme_registry.task import load, materialize
from sme_registry.task.loading import (
    _TESTED,
    _draw_cached,
    check_fingerprint,
    fingerprint_of,
    load_task,
)
from tests.strategies import specs


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "mine.json"
    sme_registry.save(
        SMESpec(state_dim=3, action_dim=2, seed=5), path, description="ä", tags=("a",)
    )
    return path


def changed(path, **fields):
    """The file with some of its fields replaced."""
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
    return path


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
@given(spec=specs())
def test_a_spec_survives_its_file(spec, tmp_path):
    path = sme_registry.save(spec, tmp_path / "task.json", force=True)
    loaded = sme_registry.load(path)  # checks the fingerprint
    assert loaded == spec
    assert loaded.digest == spec.digest


def test_a_file_says_what_it_is_and_its_name_is_no_part_of_the_identity(saved):
    file = EnvFile.read(saved)
    assert (file.name, file.version, file.versioned_name) == ("mine", 1, "mine-v1")
    assert (file.description, file.tags) == ("ä", ("a",))
    assert file.digest == file.spec.digest
    assert list(json.loads(saved.read_text())) == [
        "name", "version", "description", "tags", "digest", "spec", "fingerprint",
    ]  # fmt: skip
    after = sme_registry.load(changed(saved, name="other", description="better", tags=[]))
    assert (after, after.digest) == (file.spec, file.digest)
    assert load_task(saved, seed=6).spec == after.derive(seed=6)  # has no fingerprint to match


def test_a_changed_spec_or_digest_is_noticed(saved):
    fields = json.loads(saved.read_text())["spec"] | {"seed": 6}
    with pytest.raises(DigestMismatchError) as caught:
        sme_registry.load(changed(saved, spec=fields))
    message = str(caught.value)
    assert str(saved) in message
    assert SMESpec.from_dict(fields).digest in message
    assert "Take the file again from its source, or save the changed spec as a new file" in message
    fields["seed"] = 5
    with pytest.raises(DigestMismatchError):
        sme_registry.load(changed(saved, spec=fields, digest="sha256:" + "0" * 64))


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [
        (EnvFile, "sme_registry.save("),
        (SuiteFile, "SuiteFile(name=…, digest=suite.digest, suite=suite).write(path)"),
        (ProtocolFile, "ProtocolFile(name=…, digest=protocol.digest, protocol=protocol)"),
        (StudyFile, "`sme study new NEW.json --from mine.json`"),
    ],
)
def test_of_what_has_no_digest_or_another_the_remedy_of_its_kind_is_named(kind, remedy):
    plain = catalogue.entries(kind)[0].to_dict()
    without = {field: value for field, value in plain.items() if field != "digest"}
    for data in (without, plain[kind.content], plain | {"digest": "sha256:" + "0" * 64}):
        with pytest.raises(SpecError, match="digest") as caught:
            kind.from_dict(data, "mine.json")
        assert remedy in str(caught.value)


def test_other_numbers_than_the_published_neither_load_nor_run(saved):
    good = json.loads(saved.read_text())["fingerprint"]
    first, second, third = good["next_state"]
    fragment = "next_state: differs by 2e-06"
    for next_state, words in (
        ([first, [second[0], second[1], second[2] + 2e-6], third], f"json: fingerprint.{fragment}"),
        ([first, second], "next_state: has another shape"),
        ([first, second[:1], third], "next_state: has another shape"),
        ([["1e999", *first[1:]], second, third], "next_state: differs by inf"),
    ):
        changed(saved, fingerprint=good | {"next_state": next_state})
        saved.write_text(saved.read_text().replace('"1e999"', "1e999"))
        with pytest.raises(FingerprintMismatchError, match=words):
            sme_registry.load(saved)
    off = [first, [second[0], second[1], second[2] + 5e-7], third]
    sme_registry.load(changed(saved, fingerprint=good | {"next_state": off}))  # rounding
    off[1][2] += 1.5e-6
    file = EnvFile.read(changed(saved, fingerprint=good | {"next_state": off}))
    for run in (
        lambda: sme_registry.materialize(file.spec, file.fingerprint),
        lambda: load(saved, SMESpec),
        lambda: load_task(str(saved)),
        lambda: sme_registry.make(saved),
        lambda: sme_registry.make_vec(saved, 2),
        lambda: sme_registry.make_parallel(saved),
        lambda: sme_registry.make_aec(saved),
        lambda: sme_registry.env_spec(saved),
        lambda: sme_registry.env_spec(saved, seed=6),
        lambda: gymnasium.make("SME/Default-v1", spec=str(saved)),
        lambda: gymnasium.make_vec("SME/Default-v1", 2, spec=str(saved)),
        lambda: sme_registry.evaluate(lambda s: s, saved),
    ):
        with pytest.raises(FingerprintMismatchError, match=fragment):
            run()


def test_a_file_without_a_fingerprint_says_how_to_write_one(saved):
    data = json.loads(saved.read_text())
    del data["fingerprint"]
    with pytest.raises(SpecError, match=r"fingerprint: missing: .*sme_registry\.save\(spec, path"):
        EnvFile.from_dict(data)


def test_the_versions_of_the_fingerprints_are_those_of_the_constraints():
    pinned = (Path(__file__).parents[2] / "constraints.txt").read_text().splitlines()
    assert [*_TESTED.split(" and ")] == [
        line for line in pinned if line.startswith(("numpy==", "scipy=="))
    ]


WHOLE = SMESpec(
    state_dim=3, action_dim=2, safety={"tightness": 0.2},
    observation={"distractors": 2, "dynamics": "driven", "mixing": "nonlinear"},
)  # fmt: skip


@pytest.mark.parametrize("field", ["limit", "next_distractors", "seen"])
def test_a_fingerprint_holds_limits_distractors_and_what_is_seen(field):
    task = materialize(WHOLE)
    published = fingerprint_of(task).to_dict()
    check_fingerprint(Fingerprint.from_dict(published), task)
    off = json.loads(json.dumps(published))
    off[field][1][1] += 2e-6
    with pytest.raises(FingerprintMismatchError, match=f"fingerprint.{field}: differs by 2e-06"):
        check_fingerprint(Fingerprint.from_dict(off), task)
    missing = {name: rows for name, rows in published.items() if name != field}
    with pytest.raises(FingerprintMismatchError, match=f"fingerprint.{field}: is missing"):
        check_fingerprint(Fingerprint.from_dict(missing), task)
    plain = materialize(SMESpec(state_dim=3, action_dim=2))
    foreign = fingerprint_of(plain).to_dict() | {field: published[field]}
    with pytest.raises(FingerprintMismatchError, match=f"fingerprint.{field}: is present"):
        check_fingerprint(Fingerprint.from_dict(foreign), plain)


def test_one_bad_file_does_not_spoil_the_equal_spec_from_elsewhere(saved):
    spec = SMESpec(state_dim=3, action_dim=2, seed=987)
    good = sme_registry.save(spec, saved.with_name("good.json"))
    text = good.read_text()
    _draw_cached.cache_clear()
    bad = saved.with_name("bad.json")
    bad.write_text(text)
    numbers = json.loads(text)["fingerprint"]
    numbers["next_state"][0][0] += 0.1
    changed(bad, fingerprint=numbers)
    with pytest.raises(FingerprintMismatchError):
        sme_registry.load(bad)
    task = sme_registry.materialize(spec)
    assert sme_registry.materialize(task.spec) is task


def test_saving_under_a_bad_name_writes_nothing(tmp_path):
    for arguments in ({"name": "my task"}, {"tags": ("x y",)}, {"description": "x" * 2001}):
        with pytest.raises(SpecError):
            sme_registry.save(SMESpec(), tmp_path / "task.json", **arguments)
    with pytest.raises(SpecError, match="name='my task': must be a string of 1 to 64 letters"):
        sme_registry.save(SMESpec(), tmp_path / "my task.json")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "task.json").mkdir()
    for force, path in ((True, tmp_path / "task.json"), (False, tmp_path), (False, "Deep16")):
        with pytest.raises(OptionError, match=f"{path}: must be the path of a file"):
            sme_registry.save(SMESpec(), path, force=force)


def test_only_force_replaces_the_file_of_another_task_and_whole(saved):
    before = saved.read_bytes()
    with pytest.raises(OptionError, match="already exists"):
        sme_registry.save(SMESpec(seed=9), saved)
    assert saved.read_bytes() == before
    sme_registry.save(SMESpec(seed=9), saved, force=True)
    assert sme_registry.load(saved) == SMESpec(seed=9)
    assert [child.name for child in saved.parent.iterdir()] == ["mine.json"]
