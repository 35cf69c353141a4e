"""Execute the tutorials and store their outputs: `make tutorials`, or by name

    python docs/notebooks.py [NAME ...]

Without names, those whose code or outputs have changed since outputs were last stored. Each runs in
an empty folder. What is stored has no progress bars and no warnings: only results.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

HERE = Path(__file__).resolve().parent
FOLDER = HERE / "tutorials"
_COLOURS = 128
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_ENVIRONMENT = {
    "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
    "PYTHONPATH": str(HERE.parent),
    "MPLBACKEND": "agg",
    "OMP_NUM_THREADS": "1",  # the same numbers on any number of cores
    "MINARI_DATASETS_PATH": "datasets",  # in the folder of the execution, not the user's
    "XDG_CONFIG_HOME": "config",
}


def digest(notebook: NotebookNode) -> str:
    """The SHA-256 of all code and outputs: no cell has changed and no output is missing."""
    code = [(cell.source, cell.outputs) for cell in notebook.cells if cell.cell_type == "code"]
    return hashlib.sha256(json.dumps(code, sort_keys=True).encode()).hexdigest()


def is_current(notebook: NotebookNode) -> bool:
    """Whether the outputs are those of the code."""
    return notebook.metadata.get("sme_registry") == {"outputs": digest(notebook)}


def execute(notebook: NotebookNode) -> None:
    """Run all cells in an empty folder, and keep their results."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= _ENVIRONMENT
        NotebookClient(
            notebook,
            timeout=None,  # a machine may be busy
            kernel_name="python3",
            record_timing=False,
            coalesce_streams=True,  # else long lines of a shell are broken
            resources={"metadata": {"path": folder}},
        ).execute()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
            for output in cell.outputs:
                _clean(output)
    language = {"name": "python", "pygments_lexer": "ipython3"}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    stored = {"outputs": digest(notebook)}
    notebook.metadata = NotebookNode(kernelspec=kernel, language_info=language, sme_registry=stored)


def _clean(output: NotebookNode) -> None:
    """Store text without colours, and a figure with few, in a third of the space."""
    if output.output_type == "stream":
        output.text = _COLOUR.sub("", output.text)
    elif png := output.get("data", {}).get("image/png"):
        content = io.BytesIO()
        image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
        image.quantize(_COLOURS, dither=Image.Dither.NONE).save(content, "PNG", optimize=True)
        output.data["image/png"] = base64.b64encode(content.getvalue()).decode()


def main() -> None:
    """Execute what is asked for, and write it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    known = {path.stem: path for path in sorted(FOLDER.glob("*.ipynb"))}
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)}")
    names = parser.parse_args().names
    if unknown := set(names) - known.keys():
        parser.error(f"{', '.join(sorted(unknown))}: must be of {', '.join(known)}.")
    for name in names or known:
        notebook = nbformat.read(known[name], as_version=4)
        if names or not is_current(notebook):
            execute(notebook)
            nbformat.write(notebook, known[name])
            print(f"wrote {known[name]}", flush=True)


if __name__ == "__main__":
    main()
