"""What is published: files, metadata, citation, and the workflow that publishes it."""

import json
import re
import runpy
import shutil
import tarfile
import tomllib
import zipfile
from email import message_from_string

import pytest
import yaml

import sme_registry
from tests.wheel.conftest import ROOT

CONTENTS = runpy.run_path(str(ROOT / ".ci" / "contents.py"))
NOT_PUBLISHED = CONTENTS["NOT_PUBLISHED"]
faults_of_sdist, faults_of_wheel = CONTENTS["faults_of_sdist"], CONTENTS["faults_of_wheel"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DECLARED = {
    entry.rpartition(" ")[2]
    for entry in PROJECT["classifiers"]
    if re.fullmatch(r"Programming Language :: Python :: 3\.\d+", entry)
}
WORKFLOWS = ROOT / ".github" / "workflows"
CFF_KEYS = {
    "abstract", "authors", "cff-version", "commit", "contact", "date-released", "doi",
    "identifiers", "keywords", "license", "license-url", "message", "preferred-citation",
    "references", "repository", "repository-artifact", "repository-code", "title", "type", "url",
    "version",
}  # fmt: skip


def in_clone(name):
    path = ROOT / name
    if not path.exists() and not (ROOT / ".git").exists():
        pytest.skip("an sdist has no workflows")
    return path


def test_the_wheel_holds_the_packages_and_the_catalogue_and_nothing_else(wheel):
    assert faults_of_wheel(wheel) == []
    names = zipfile.ZipFile(wheel).namelist()
    for name in (
        "sme_registry/py.typed",
        "leaderboard/py.typed",
        "sme_registry/specs/envs/Default-v1.json",
        "leaderboard/web/templates/_base.html",
    ):
        assert name in names
    assert any(name.startswith("sme_registry/diagnosis/templates/") for name in names)
    assert not any(name.startswith("tests/") for name in names)


def test_the_sdist_holds_the_source_tree(built):
    (sdist,) = built.glob("*.tar.gz")
    assert faults_of_sdist(sdist) == []
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"tests/conftest.py", "specs/suites/smoke-v1.json", "CHANGELOG.md"} <= names
    assert not {name.split("/")[0] for name in names} & NOT_PUBLISHED


def test_files_too_many_too_few_and_too_large_are_found(wheel, tmp_path):
    changed = tmp_path / wheel.name
    shutil.copy(wheel, changed)
    with zipfile.ZipFile(changed, "a") as archive:
        archive.writestr("sme_registry/__pycache__/x.pyc", b"")
        archive.writestr("notes.bin", bytes(600_000))
    faults = "\n".join(faults_of_wheel(changed))
    assert "x.pyc: does not belong here" in faults
    assert "x.pyc: is a cache" in faults
    assert "notes.bin: 600,000 bytes" in faults
    with zipfile.ZipFile(tmp_path / "few.whl", "w") as archive:
        archive.writestr("sme_registry-0.dist-info/METADATA", "")
    assert any("py.typed: is missing" in fault for fault in faults_of_wheel(tmp_path / "few.whl"))


def test_the_metadata_state_what_was_tried(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
    metadata = message_from_string(archive.read(name).decode())
    assert metadata["Version"] == sme_registry.__version__
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["License-File"] == "LICENSE"
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert "Typing :: Typed" in metadata.get_all("Classifier")
    lowest = min(DECLARED, key=lambda text: int(text.partition(".")[2]))
    assert metadata["Requires-Python"] == f">={lowest}"


def test_citation_and_archive_agree_with_the_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    archive = json.loads((ROOT / ".zenodo.json").read_text())
    assert citation.keys() <= CFF_KEYS
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == sme_registry.__version__
    assert citation["title"] == archive["title"]
    assert citation["license"] == archive["license"] == PROJECT["license"]
    assert citation["abstract"].strip() == archive["description"]
    assert citation["keywords"] == archive["keywords"]
    assert set(citation["keywords"]) <= set(PROJECT["keywords"])
    names = [author["name"] for author in PROJECT["authors"]]
    assert [author["name"] for author in citation["authors"]] == names
    assert [creator["name"] for creator in archive["creators"]] == names
    paper = citation["references"][0]["identifiers"][0]["value"]
    assert [each["identifier"] for each in archive["related_identifiers"]] == [paper]


def test_the_release_publishes_what_it_has_tested_on_every_declared_python():
    jobs = yaml.safe_load(in_clone(".github/workflows/release.yml").read_text())["jobs"]
    assert set(jobs["test"]["strategy"]["matrix"]["python"]) == DECLARED
    assert jobs["test"]["needs"] == "build"
    assert jobs["publish"]["needs"] == "test"
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert jobs["publish"]["environment"]
    built = [step for step in jobs["build"]["steps"] if ".ci/build" in step.get("run", "")]
    assert len(built) == 1
    assert not any("build" in step.get("run", "") for step in jobs["publish"]["steps"])


@pytest.mark.parametrize("name", ["ci.yml", "release.yml"])
def test_workflows_pin_actions_by_commit_and_may_write_nothing(name):
    text = in_clone(f".github/workflows/{name}").read_text()
    used = re.findall(r"uses: (\S+)", text)
    assert used
    for action in used:
        assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", action), action
    assert yaml.safe_load(text)["permissions"] == {"contents": "read"}
