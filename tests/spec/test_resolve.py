"""Every name of a task resolves to its spec; the error of an unknown name suggests the nearest."""

import shutil

import pytest

from sme_registry.errors import MalformedDocumentError, SMEError, SpecError, UnknownNameError
from sme_registry.spec import EnvFile, SMESpec, StreamFile, StreamSpec, catalogue
from sme_registry.spec.resolve import resolve, resolve_document

DEFAULT = catalogue.find(EnvFile, "Default-v1")


@pytest.mark.parametrize(
    "name",
    [
        "SME/Default-v1",
        "Default-v1",
        "Default",
        "SME/Default",
        "sme_registry:SME/Default-v1",
        f"SME/{DEFAULT.spec.content_name}-v1",
        DEFAULT.spec.content_name,
        DEFAULT.digest,
        DEFAULT.digest[: 7 + 12],
        DEFAULT.digest[:30],
        DEFAULT.digest.upper().replace("SHA", "sha"),
        str(catalogue.spec_folder() / "envs" / "Default-v1.json"),
        catalogue.spec_folder() / "envs" / "Default-v1.json",
        {},
        {"complexity": 1},
        SMESpec(),
    ],
)
def test_every_name_of_the_default_task_leads_to_it(name):
    assert resolve(name).spec == SMESpec()


STREAM = catalogue.find(StreamFile, "Cycle2-v1")


@pytest.mark.parametrize(
    ("name", "document"),
    [
        ("Default", SMESpec()),
        ({"complexity": 1}, SMESpec()),
        (catalogue.spec_folder() / "envs" / "Default-v1.json", SMESpec()),
        ("Cycle2", STREAM.stream),
        (STREAM.digest, STREAM.stream),
        (STREAM.stream, STREAM.stream),
        (STREAM.stream.to_dict(), STREAM.stream),
        (str(catalogue.spec_folder() / "streams" / "Cycle2-v1.json"), STREAM.stream),
    ],
    ids=str,
)
def test_a_name_leads_to_a_task_or_a_stream(name, document):
    found = resolve_document(name)
    assert document == (found.stream if isinstance(document, StreamSpec) else found.spec)


def test_a_file_of_neither_a_task_nor_a_stream_is_refused(tmp_path):
    path = tmp_path / "bare.json"
    path.write_text('{"complexity": 1}')
    with pytest.raises(MalformedDocumentError, match=r"bare\.json: is a bare spec"):
        resolve_document(path)


def test_specs_of_named_files_carry_their_fingerprint_and_others_none():
    assert resolve("Default").fingerprint == DEFAULT.fingerprint
    assert resolve(DEFAULT.digest).fingerprint == DEFAULT.fingerprint
    assert resolve("Default").derive().fingerprint == DEFAULT.fingerprint
    assert resolve("Default").derive(k=7).fingerprint is None
    assert resolve({}).fingerprint is None
    assert resolve(SMESpec(k=7)).fingerprint is None


def test_instances_of_suites_are_found_by_digest():
    from sme_registry.spec import SuiteFile

    suite = catalogue.entries(SuiteFile)[0].suite
    for spec in suite.instances[:3]:
        assert resolve(spec.digest[:19]).spec == spec


def test_a_path_needs_no_ending_where_it_cannot_be_a_name(tmp_path):
    path = tmp_path / "task"
    shutil.copy(catalogue.spec_folder() / "envs" / "Default-v1.json", path)
    assert resolve(path).spec == SMESpec()
    assert resolve(str(path)).spec == SMESpec()


@pytest.mark.parametrize(
    ("name", "fragment"),
    [
        ("Defualt", "Did you mean 'Default-v1'"),
        ("default-v1", "Did you mean 'Default-v1'"),
        ("SME/Complexity11-v1", "Did you mean 'Complexity1"),
        ("SME/Default-v2", "Did you mean 'Default-v1'"),
        ("xyzzy", "`sme list` shows the names."),
        ("", "`sme list` shows the names."),
        ("sha256:66e9", "give at least 12 hex digits"),
        ("sha256:zzzzzzzzzzzz", "load its file instead"),
        (DEFAULT.digest[:18] + "0", f"Did you mean '{DEFAULT.digest[:19]}'?"),
        (f"SME/{DEFAULT.spec.content_name}-v9", "no task has version 9 of the dynamics"),
    ],
)
def test_the_error_of_an_unknown_name_suggests_the_nearest(name, fragment):
    with pytest.raises(UnknownNameError) as caught:
        resolve(name)
    assert fragment in str(caught.value)
    assert isinstance(caught.value, LookupError)


@pytest.mark.parametrize("thing", [None, 5, b"Default-v1", ["Default-v1"], 0.5, SMESpec])
def test_what_names_nothing_at_all_is_refused(thing):
    with pytest.raises(SpecError, match="must be an SMESpec or a mapping"):
        resolve(thing)


@pytest.mark.parametrize("path", ["/no/such/file.json", "no-such.json", "a\0.json"])
def test_a_missing_file_says_so(path):
    with pytest.raises(MalformedDocumentError, match="cannot be read"):
        resolve(path)


def test_a_bare_spec_is_distinguished_from_a_file(tmp_path):
    path = tmp_path / "bare.json"
    path.write_text(SMESpec(k=5).model_dump_json())
    with pytest.raises(MalformedDocumentError, match=r"bare spec.*sme_registry\.save"):
        resolve(path)


def test_nothing_but_our_errors_comes_of_odd_names():
    for name in ("/", "//", "SME/", ":", "SME/Default-v1-v1", "\0", "é" * 1000, "sha256:", "-v1"):
        with pytest.raises(SMEError):
            resolve(name)
