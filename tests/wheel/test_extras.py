"""With each extra alone, every command answers, in one line where a package is missing.

An extra alone is this environment in which an import of any other package fails. The core's answers
say which commands need which extra, and each extra then runs the commands that asked for it.
"""

import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
NAME = "sme-registry"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = [extra for extra in PROJECT["optional-dependencies"] if extra != "dev"]
HINT = re.compile(r"pip install .*\[(\w+)\]")


def closure(extra):
    """The installed distributions that the package with an extra needs."""
    waiting = [(Requirement(f"{NAME}[{extra}]" if extra else NAME), "")]
    visited = set()
    while waiting:
        requirement, chosen = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": chosen}):
            continue
        name = normalised(requirement.name)
        for inner in {"", *requirement.extras} - {extra for n, extra in visited if n == name}:
            visited.add((name, inner))
            try:
                needs = metadata.requires(name) or []
            except metadata.PackageNotFoundError:  # an optional part that is not installed
                continue
            waiting += [(Requirement(text), inner) for text in needs]
    return {name for name, _ in visited}


def normalised(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def missing(extra):
    """The modules of this environment that one with this extra alone would not have."""
    present = closure(extra)
    return [
        module
        for module, owners in metadata.packages_distributions().items()
        if not present & {normalised(owner) for owner in owners}
    ]


def outcomes(extra, folder, commands):
    """What every `--help`, or these commands, answer where only this extra is installed."""
    folder.mkdir(parents=True)
    request = json.dumps({"missing": missing(extra), "commands": commands})
    script = Path(__file__).with_name("run_commands.py")
    settings = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(folder),
        "OMP_NUM_THREADS": "1",
        "SME_BACKEND": "numpy",
        "PYTHONPATH": str(ROOT),
        "PYTHONDONTWRITEBYTECODE": os.environ.get("PYTHONDONTWRITEBYTECODE", ""),
    }
    process = subprocess.run(
        [sys.executable, "-W", "ignore", script],
        input=request,
        cwd=folder,
        env=settings,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout)


def checked(outcome, extra):
    """The extras that an answer names, after the rules that hold for every answer."""
    context = json.dumps(outcome, indent=1)
    if outcome["command"].endswith("--help"):
        assert outcome["code"] == 0, context
        return []
    assert outcome["code"] in (0, 1, 2), context
    if outcome["code"] == 2:
        assert outcome["err"].splitlines()[-1].startswith("error: "), context
    named = HINT.findall(outcome["err"])
    assert set(named) <= {*EXTRAS} - {extra}, context
    assert ("not installed" in outcome["err"]) == bool(named), context
    return named


@pytest.fixture(scope="module")
def asked(once):
    """For each extra the commands that asked for it where only the core is installed."""

    def core(folder):
        asked = {extra: [] for extra in EXTRAS}
        for outcome in outcomes("", folder / "core", []):
            for extra in checked(outcome, ""):
                asked[extra].append(outcome["command"])
        (folder / "asked.json").write_text(json.dumps(asked))

    return json.loads((once("extras", core) / "asked.json").read_text())


def test_with_the_core_alone_commands_answer_and_name_their_extras(asked):
    needed = {extra for extra, commands in asked.items() if commands}
    assert needed >= {"train", "plot", "studies", "offline", "leaderboard"}
    assert "sme study plan smoke" in asked["train"]


@pytest.mark.parametrize("extra", EXTRAS)
def test_with_an_extra_alone_the_commands_that_asked_for_it_get_further(extra, asked, tmp_path):
    if asked[extra]:
        answers = outcomes(extra, tmp_path / "work", asked[extra])
        assert any(not checked(outcome, extra) for outcome in answers)
