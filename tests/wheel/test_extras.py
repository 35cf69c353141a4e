"""The wheel with each extra alone: every command answers, in one line where a package is missing.

An environment is a real one, but its packages are links to those of this environment: the closure
of the extra's requirements and nothing else.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
NAME = "sme-registry"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = [extra for extra in PROJECT["optional-dependencies"] if extra != "dev"]
HINT = re.compile(rf"install .?{NAME}\[(\w+)\]")


def closure(requirements: list[str], extra: str) -> set[str]:
    """The installed distributions that these requirements of a package need."""
    waiting = [(Requirement(text), extra) for text in requirements]
    done: set[tuple[str, str]] = set()
    names: set[str] = set()
    while waiting:
        requirement, chosen = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": chosen}):
            continue
        for inner in ("", *requirement.extras):
            if (requirement.name, inner) in done:
                continue
            done.add((requirement.name, inner))
            if requirement.name == NAME:
                needs = requirements
            else:
                names.add(requirement.name)
                try:
                    needs = metadata.requires(requirement.name) or []
                except metadata.PackageNotFoundError:  # an optional part that is not installed
                    names.discard(requirement.name)
                    continue
            waiting += [(Requirement(text), inner) for text in needs]
    return names


def environment(folder: Path, wheel: Path, extra: str) -> Path:
    """Create an environment with the wheel and an extra; returns its interpreter."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    scheme = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", "venv", scheme))
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
        (record,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        requirements = metadata.PathDistribution(site / Path(record).parent).requires or []
    for name in closure(requirements, extra):
        distribution = metadata.distribution(name)
        for top in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(Path(str(distribution.locate_file(top))))
    return folder / "bin" / "python"


def outcomes(python: Path, folder: Path) -> list[dict[str, Any]]:
    folder.mkdir()
    script = str(Path(__file__).with_name("run_commands.py"))
    settings = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(folder),
        "OMP_NUM_THREADS": "1",
        "SME_BACKEND": "numpy",
    }
    done = subprocess.run(
        [python, "-W", "ignore", script], cwd=folder, env=settings, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    result: list[dict[str, Any]] = json.loads(done.stdout)
    return result


@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_with_one_extra_every_command_answers_in_one_line(
    extra: str, wheel: Path, tmp_path: Path
) -> None:
    python = environment(tmp_path / "venv", wheel, extra)
    for outcome in outcomes(python, tmp_path / "work"):
        context = json.dumps(outcome, indent=1)
        if outcome["command"].endswith("--help"):
            assert outcome["code"] == 0, context
            continue
        assert outcome["code"] in (0, 1, 2), context
        if outcome["code"] == 2:
            last = outcome["err"].splitlines()[-1]
            assert last.startswith("error: "), context
        for named in HINT.findall(outcome["err"]):
            assert named in EXTRAS, context
            assert named != extra, context
        assert ("not installed" in outcome["err"]) == bool(HINT.search(outcome["err"])), context
