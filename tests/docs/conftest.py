"""What makes the site can be imported, and the site is built once for all tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = {path.stem: path for path in sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))}
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "docs" / "_extensions")]


@pytest.fixture(scope="session")
def site(once):
    """The folder of the site; a warning is an error."""
    pytest.importorskip("sphinx")

    def build(folder):
        # A fifth of a build's time is the garbage collector's, which finds nothing.
        program = (
            "import gc; gc.disable(); import sphinx.cmd.build as b; raise SystemExit(b.main())"
        )
        command = [sys.executable, "-c", program, "-q", "-W", "--keep-going", "-j", "2"]
        done = subprocess.run(
            [*command, "-d", folder / "doctrees", ROOT / "docs", folder / "html"],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert done.returncode == 0, done.stderr

    return once("site", build) / "html"
