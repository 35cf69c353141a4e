"""What makes the site can be imported, and the site is built once for all tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    path.stem: text  # the tutorials that are notebooks
    for path in sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    if "```python" in (text := path.read_text(encoding="utf-8"))
}
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "docs" / "_extensions")]


@pytest.fixture(scope="session")
def site(tmp_path_factory, worker_id):
    """The folder of the site, built without running the tutorials; a warning is an error."""
    pytest.importorskip("sphinx")
    shared = tmp_path_factory.getbasetemp()
    shared = shared if worker_id == "master" else shared.parent  # of all workers of pytest-xdist
    html = shared / "site"
    with FileLock(shared / "site.lock"):
        if not (shared / "site.built").exists():
            command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-j", "2"]
            options = ["-D", "nb_execution_mode=off", "-d", shared / "doctrees"]
            done = subprocess.run(
                [*command, *options, ROOT / "docs", html],
                capture_output=True,
                text=True,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )
            (shared / "site.built").write_text(f"{done.returncode}\n{done.stderr}")
    code, _, complaints = (shared / "site.built").read_text().partition("\n")
    assert code == "0", complaints
    return html
