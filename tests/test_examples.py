"""The examples run, and name the packages that they lack."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PPO_EXAMPLES = [example for example in EXAMPLES if example.stem.endswith("_ppo")]
# None in sys.modules makes an import fail as if TorchRL were not installed.
WITHOUT_TORCHRL = (
    "import runpy, sys; sys.modules['tensordict'] = sys.modules['torchrl'] = None; "
    "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
)


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.parametrize(
    "example", sorted({*EXAMPLES} - {*PPO_EXAMPLES}), ids=lambda path: path.name
)
def test_help_works_without_optional_packages(example: Path) -> None:
    done = run("-c", WITHOUT_TORCHRL, example, "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage:")


def test_a_missing_torchrl_is_named_with_the_command_that_installs_it() -> None:
    done = run("-c", WITHOUT_TORCHRL, ROOT / "examples" / "torchrl_team.py")
    assert done.returncode == 2
    assert "tensordict is not installed. Run `pip install torchrl`." in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("example", PPO_EXAMPLES, ids=lambda path: path.stem)
def test_ppo_of_a_framework_lowers_the_exact_regret(example: Path) -> None:
    """Where the framework is missing, the example says so in one line."""
    done = run(example, "--steps", "4096")
    print(done.stdout)  # for `make frameworks`
    missing = r"\S+ is not installed. docs/guides/frameworks.md has the command.\n"
    if re.fullmatch(missing, done.stderr):
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    exploring = [float(value) for value in re.findall(r"exploring: regret (\S+)", done.stdout)]
    before, after = (float(value) for value in re.findall(r"WD regret ([0-9.]+)", done.stdout))
    assert exploring[-1] < exploring[0]
    assert after < 0.8 * before


def test_the_torchrl_example_rejects_invalid_options_first() -> None:
    done = run("-c", WITHOUT_TORCHRL, ROOT / "examples" / "torchrl_team.py", "--steps", "0")
    assert done.returncode == 2
    assert "--steps must be at least 1" in done.stderr


def test_the_torchrl_example_trains() -> None:
    pytest.importorskip("torchrl")
    done = run(ROOT / "examples" / "torchrl_team.py", "--env", "Team2", "--steps", "4096")
    assert done.returncode == 0, done.stderr
    before, after = (
        [float(value) for value in line.split()[3:]]
        for line in done.stdout.splitlines()
        if "mean actions" in line
    )
    assert len(before) == len(after) == 2
    assert all(end < 0.7 * start for start, end in zip(before, after, strict=True))


def test_the_sb3_contrib_example_trains_all_algorithms() -> None:
    pytest.importorskip("sb3_contrib")
    done = run(ROOT / "examples" / "sb3_contrib_cell.py", "--env", "Plane1", "--steps", "64")
    assert done.returncode == 0, done.stderr
    rows = [line[:12].strip() for line in done.stdout.splitlines()]
    assert rows == ["algorithm", "PPO", "TRPO", "TRPO (wide)", "linear"]
