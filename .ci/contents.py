"""Do wheel and sdist hold exactly the files that belong in them? `.ci/build` and a test run this.

python contents.py FOLDER        with one wheel and one sdist in it
"""

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[1]
BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]
LARGEST = 500_000  # bytes of one file
NOT_PUBLISHED = {".gitattributes", ".github"}
METADATA = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE"}
WRITTEN = {"PKG-INFO"}


def source_files():
    """The files of this source tree: those that Git tracks or would; in an sdist, all."""
    if (ROOT / ".git").exists():
        command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        return {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    files = (path.relative_to(ROOT) for path in ROOT.rglob("*") if path.is_file())
    return {path.as_posix() for path in files if not _cache(path.as_posix())} - WRITTEN


def faults_of_wheel(path):
    """What is wrong with a wheel."""
    with zipfile.ZipFile(path) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    info = next((name.split("/")[0] for name in sizes if ".dist-info/" in name), "")
    expected = {f"{info}/{name}" for name in METADATA}
    for name in _below(BUILD["wheel"]["only-include"]):
        expected.add(f"sme_registry/{name}" if name.startswith("specs/") else name)
    return _faults(path, sizes, expected)


def faults_of_sdist(path):
    """What is wrong with an sdist, and which new file of the tree is in neither list."""
    with tarfile.open(path) as archive:
        sizes = {entry.name.partition("/")[2]: entry.size for entry in archive if entry.isfile()}
    chosen = {*BUILD["sdist"]["only-include"], "LICENSE", "README.md", "pyproject.toml"}
    faults = _faults(path, sizes, {*_below(chosen), ".gitignore", *WRITTEN})
    known = {*chosen, *NOT_PUBLISHED, ".gitignore"}
    forgotten = {name.split("/")[0] for name in source_files()} - known
    return faults + [f"{name}: neither published nor in NOT_PUBLISHED" for name in forgotten]


def _below(chosen):
    """The source files in some folders, and some files."""
    folders = {PurePosixPath(name) for name in chosen}
    paths = map(PurePosixPath, source_files())
    return {str(path) for path in paths if folders & {path, *path.parents}}


def _faults(path, sizes, expected):
    faults = [f"{name}: is missing" for name in sorted(expected - sizes.keys())]
    faults += [f"{name}: does not belong here" for name in sorted(sizes.keys() - expected)]
    faults += [f"{name}: is a cache" for name in sizes if _cache(name)]
    faults += [f"{name}: {size:,} bytes" for name, size in sizes.items() if size > LARGEST]
    return [f"{path.name}: {fault}" for fault in faults]


def _cache(name):
    return "__pycache__" in name or name.endswith((".pyc", ".pyo"))


def main(folder):
    """Name what is wrong with the wheel and the sdist in a folder, and end with an error."""
    (wheel,), (sdist,) = (list(Path(folder).glob(end)) for end in ("*.whl", "*.tar.gz"))
    faults = faults_of_wheel(wheel) + faults_of_sdist(sdist)
    if faults:
        raise SystemExit("\n".join(faults))
    print(f"{wheel.name} and {sdist.name} hold exactly the files that belong in them.")


if __name__ == "__main__":
    main(sys.argv[1])
