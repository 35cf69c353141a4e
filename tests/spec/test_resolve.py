"""Every name of a task resolves to its spec, or the nearest is suggested; sweeps of a task."""

import shutil

import pytest

from sme_registry import load
from sme_registry.cli.task import sweep_axes
from sme_registry.errors import MalformedDocumentError, SMEError, SpecError, UnknownNameError
from sme_registry.spec import EnvFile, SMESpec, SuiteFile, catalogue
from sme_registry.spec.catalogue import resolve
from sme_registry.spec.study import sweep

DEFAULT = catalogue.find(EnvFile, "Default-v1")
FOLDER = catalogue.spec_folder()


def test_every_name_of_the_default_task_leads_to_it(tmp_path):
    path = shutil.copy(FOLDER / "envs" / "Default-v1.json", tmp_path / "task")
    for name in (
        "SME/Default-v1",
        "Default-v1",
        "Default",
        "SME/Default",
        "sme_registry:SME/Default-v1",
        f"SME/{DEFAULT.spec.content_name}-v1",
        DEFAULT.spec.content_name,
        DEFAULT.digest,
        DEFAULT.digest[: 7 + 12],
        DEFAULT.digest.upper().replace("SHA", "sha"),
        str(FOLDER / "envs" / "Default-v1.json"),
        path,  # needs no ending, since it cannot be a name
        str(path),
        {},
        {"complexity": 1},
        SMESpec(),
    ):
        assert resolve(name).document == SMESpec()
    for spec in catalogue.entries(SuiteFile)[0].suite.instances[:3]:
        assert resolve(spec.digest[:19]).document == spec


def test_specs_of_named_files_carry_their_fingerprint_and_others_none():
    assert resolve("Default").fingerprints == (DEFAULT.fingerprint,)
    assert resolve(DEFAULT.digest).fingerprints == (DEFAULT.fingerprint,)
    assert resolve({}).fingerprints == ()
    assert resolve(SMESpec(k=7)).fingerprints == ()


def test_the_error_of_an_unknown_name_suggests_the_nearest():
    for name, fragment in (
        ("Defualt", "Did you mean 'Default-v1'"),
        ("SME/Default-v2", "Did you mean 'Default-v1'"),
        ("", "`sme list` shows the names."),
        ("sha256:66e9", "give at least 12 hex digits"),
        ("sha256:zzzzzzzzzzzz", "load its file instead"),
        (f"SME/{DEFAULT.spec.content_name}-v9", "or its suites has this digest"),
    ):
        with pytest.raises(UnknownNameError) as caught:
            resolve(name)
        assert fragment in str(caught.value)
        assert isinstance(caught.value, LookupError)
    for name in ("/", "//", "SME/", ":", "SME/Default-v1-v1", "\0", "é" * 1000, "sha256:", "-v1"):
        with pytest.raises(SMEError):
            resolve(name)


def test_what_names_nothing_at_all_is_refused():
    for thing in (None, 5, b"Default-v1", ["Default-v1"], 0.5, SMESpec):
        with pytest.raises(SpecError, match="must be an SMESpec or a mapping"):
            resolve(thing)
    for path in ("/no/such/file.json", "no-such.json", "a\0.json"):
        with pytest.raises(MalformedDocumentError, match="cannot be read"):
            resolve(path)


def test_a_single_axis_has_one_class_for_each_value():
    classes = sweep(SMESpec(seed=3), {"r_min": [0, 0.25, 0.5]}, instances=2)
    assert [member.name for member in classes] == ["r_min-0", "r_min-0_25", "r_min-0_5"]
    assert [member.setting.r_min for member in classes] == [0.0, 0.25, 0.5]
    assert {member.seeds for member in classes} == {(3, 4)}


def test_several_axes_share_the_task_itself():
    classes = sweep(SMESpec(), {"k": [1, 5], "complexity": [1, 10]}, name="Default")
    assert [member.name for member in classes] == ["Default", "k-5", "complexity-10"]
    assert classes[2].setting.k == 1  # no cross product


def test_values_are_json_or_text_and_a_field_of_a_team_has_a_dotted_name():
    axes = sweep_axes(["k=1,2,5", "policy_init=semi_orthogonal,unit_variance"])
    assert axes == {"k": [1, 2, 5], "policy_init": ["semi_orthogonal", "unit_variance"]}
    classes = sweep(load("Team2"), sweep_axes(['team.agents.0.observes=[0],"all"']))
    assert [member.name for member in classes] == [
        "team-agents-0-observes-0", "team-agents-0-observes-1",
    ]  # fmt: skip
    observed = [member.instances[0].team.agents[0].observes for member in classes]
    assert observed == [(0,), "all"]


def test_bad_axes_are_refused():
    for axes, words in (
        ({"kk": [1]}, "kk"),
        ({"k": [0, 1]}, "k=0"),
        ({"k": [1, 1]}, "twice"),
        ({"k": []}, "no values"),
        ({"seed": [1, 2]}, "--instances"),
        ({"team.reward": ["team"]}, "no such field"),
    ):
        with pytest.raises(SMEError, match=words):
            sweep(SMESpec(), axes)
