"""Seasons are one folder: without it, the open board works as before."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from tests.leaderboard.test_cli import furnish

ROOT = Path(__file__).resolve().parents[2]
COMMAND = (sys.executable, "-c", "from leaderboard.cli import main; main()")
COMMANDS = """
import json, sys
from leaderboard.cli import main
for command in json.loads(sys.argv[1]):
    sys.argv[1:] = command
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
"""
TINY = ("--suite", "tiny-v1.json")


@pytest.fixture
def run(home, monkeypatch):
    """Runs a command of a copy of the package in which the folder was deleted."""
    package = home / "copy" / "leaderboard"
    shutil.copytree(ROOT / "leaderboard", package, ignore=shutil.ignore_patterns("seasons"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (package.parent, ROOT))))
    furnish(home)

    def run(*commands):
        every = (sys.executable, "-c", COMMANDS, json.dumps(commands))
        done = subprocess.run(every, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_the_open_board_works_without_the_folder_of_seasons(run):
    init = ["init", "board", *TINY, "--protocol", "small-v1.json", "--runs-to-rank", "2"]
    assert "ticket" not in run(init, ["--help"])
    serve = (*COMMAND, "serve", "board", "--port", "0", "--workers", "0")
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as served:
        try:
            url = next(word for word in served.stdout.readline().split() if "://" in word)
            names = "--submitter", "A Lab", "--method", "Linear"
            id = run(["submit", "runs.json", url, *names]).split()[-1]
            assert httpx.get(f"{url}/api/seasons").status_code == 404
            entries = httpx.get(f"{url}/api/log").json()["entries"]
            assert [each["event"] for each in entries] == ["opened", *["received"] * 3]
        finally:
            served.send_signal(signal.SIGINT)
    assert served.returncode == 0
    shown = run(
        ["score", "board"],
        ["verify", "board", "--rescore", "1"],
        ["site", "board", "--out", "site"],
        ["rank", "board", "--json"],
    )
    assert "3 scored" in shown
    assert "Verified" in shown
    rows = json.loads(shown[shown.index("{") :])["rows"]
    assert {row["id"]: row["method"] for row in rows}[id] == "Linear"
    assert "Linear" in Path("site/index.html").read_text()
    assert not Path("site/seasons.html").exists()
