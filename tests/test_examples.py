"""The examples run, and name the packages that they lack."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PPO_EXAMPLES = [example for example in EXAMPLES if example.stem.endswith("_ppo")]


def run(*arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.parametrize(
    ("example", "arguments", "code", "message"),
    [
        *((path.name, ["--help"], 0, "usage:") for path in EXAMPLES if path not in PPO_EXAMPLES),
        ("torchrl_team.py", [], 2, "tensordict is not installed. Run `pip install torchrl`."),
        ("torchrl_team.py", ["--steps", "0"], 2, "--steps must be at least 1"),
    ],
)
def test_without_torchrl_an_example_helps_or_says_what_is_wrong(
    example, arguments, code, message, monkeypatch, capsys
):
    for package in ("tensordict", "torchrl"):
        monkeypatch.setitem(sys.modules, package, None)  # its import fails
    monkeypatch.setattr(sys, "argv", [example, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "examples" / example), run_name="__main__")
    assert ended.value.code == code
    printed = capsys.readouterr()
    assert message in printed.out + printed.err


@pytest.mark.parametrize("example", PPO_EXAMPLES, ids=lambda path: path.stem)
def test_ppo_of_a_framework_lowers_the_exact_regret(example):
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


def test_the_torchrl_example_trains():
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


def test_the_sb3_contrib_example_trains_all_algorithms():
    pytest.importorskip("sb3_contrib")
    done = run(ROOT / "examples" / "sb3_contrib_cell.py", "--env", "Plane1", "--steps", "64")
    assert done.returncode == 0, done.stderr
    rows = [line[:12].strip() for line in done.stdout.splitlines()]
    assert rows == ["algorithm", "PPO", "TRPO", "TRPO (wide)", "linear"]
