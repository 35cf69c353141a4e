"""Installed packages: their versions, how to install missing ones, and objects in them by name."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import re
import shlex
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from sme_registry.errors import MissingDependencyError, SMEError, did_you_mean
from sme_registry.version import __version__

_NAME = "sme-registry"
_SOURCE = Path(__file__).parents[2]  # the clone, if the package runs from one
_EXTRA = re.compile(r"""([\w.-]+).*\bextra\s*==\s*['"]([\w-]+)['"]""")


def versions(packages: Iterable[str], *, if_imported: Iterable[str] = ()) -> dict[str, str]:
    """Versions of this package, of Python, and of the named packages that are installed.

    Args:
      packages: names as `pip` or as `import` has them ("stable_baselines3").
      if_imported: packages to include only if this process has imported them.

    Returns:
      `sme_registry` and `python`, then each package in order; those not installed are absent.
    """
    installed = {"sme_registry": __version__, "python": platform.python_version()}
    for name in (*packages, *(name for name in if_imported if name in sys.modules)):
        try:
            installed[name] = metadata.version(name)
        except (metadata.PackageNotFoundError, ValueError):  # ValueError: an empty name
            continue
    return installed


def is_installed(package: str) -> bool:
    """Whether a package can be imported; does not import it."""
    return importlib.util.find_spec(package) is not None


def require_packages(
    purpose: str, packages: Mapping[str, str], extra: str, *, otherwise: str = ""
) -> None:
    """Check that optional packages, full names by the name to import, are installed.

    Args:
      purpose: what needs them.
      packages: full names by the name to import.
      extra: the extra of our package that installs them.
      otherwise: what to do instead of installing, such as `unset the variable`.

    Raises:
      MissingDependencyError: names the purpose, the missing packages, and the command that installs
        them, with this extra of our package.
    """
    missing = [name for package, name in packages.items() if not is_installed(package)]
    if missing:
        raise _missing(missing, extra, f"{purpose}: ", otherwise)


def missing_dependency(
    error: ModuleNotFoundError, extra: str = ""
) -> MissingDependencyError | None:
    """The error to report instead of a failed import: which extra has the module.

    Args:
      error: the failed import.
      extra: the extra to name if it has the module; otherwise the smallest that has it.

    Returns:
      None if no extra of our package has the module: then the import is a fault of ours.
    """
    module = (error.name or "").partition(".")[0]
    package = module.lower().replace("_", "-")
    extras = {name: has for name, has in _extras().items() if package in has and name != "dev"}
    if not extras:
        return None
    smallest = min(extras, key=lambda name: len(extras[name]))
    return _missing([module], extra if extra in extras else smallest)


def install_command(extra: str) -> str:
    """The command that installs an extra in the way in which this package was installed.

    It names the clone, the wheel or the repository that the package came from; only a package from
    an index is installed again by its name alone.
    """
    options, requirement = [], f"{_NAME}[{extra}]"
    origin = _origin()
    if (_SOURCE / "pyproject.toml").is_file():
        options, requirement = ["-e"], _in_folder(_SOURCE, extra)
    elif "dir_info" in origin:
        folder = Path(url2pathname(urlsplit(origin["url"]).path))
        if folder.is_dir():
            requirement = _in_folder(folder, extra)
    elif "url" in origin:
        revision = origin.get("vcs_info", {}).get("vcs")
        requirement += f" @ {revision + '+' if revision else ''}{origin['url']}"
    return shlex.join([*_pip(), "install", *options, requirement])


def _missing(
    packages: Sequence[str], extra: str, purpose: str = "", otherwise: str = ""
) -> MissingDependencyError:
    verb = "is" if len(packages) == 1 else "are"
    return MissingDependencyError(
        f"{purpose}{' and '.join(packages)} {verb} not installed. "
        f"Run `{install_command(extra)}`{', or ' + otherwise if otherwise else ''}."
    )


def _in_folder(folder: Path, extra: str) -> str:
    return f"{'.' if folder == Path.cwd() else folder}[{extra}]"


def _pip() -> list[str]:
    """This environment's pip, also where the `pip` of the shell belongs to another one."""
    found = shutil.which("pip")
    here = found is not None and Path(found).parent == Path(sys.executable).parent
    return ["pip"] if here else [sys.executable, "-m", "pip"]


def _origin() -> dict[str, Any]:
    """Where the package was installed from, as PEP 610 records it; empty for an index."""
    try:
        text = metadata.distribution(_NAME).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return {}
    return dict(json.loads(text)) if text else {}


def _extras() -> dict[str, set[str]]:
    """The packages of each extra; those of an extra that it contains are included."""
    try:
        requirements = metadata.requires(_NAME) or []
    except metadata.PackageNotFoundError:
        return {}
    extras: dict[str, set[str]] = {}
    for match in filter(None, map(_EXTRA.match, requirements)):
        package, extra = match.groups()
        extras.setdefault(extra, set()).add(package.lower().replace("_", "-"))
    return extras


def import_object(name: str, field: str, error: type[SMEError]) -> Any:
    """Import an object by the name `module:attribute`. The working directory is searched first.

    Importing a module runs its code.

    Raises:
      SMEError: of type `error`: the module or attribute does not exist, or importing it fails;
        names the field that holds the name.
    """
    module_name, _, attribute = name.partition(":")
    folder, near = os.getcwd(), ""
    sys.path.insert(0, folder)
    try:
        module = importlib.import_module(module_name)
        near = did_you_mean(attribute, dir(module))
        return getattr(module, attribute)
    except SMEError:
        raise
    except Exception as reason:
        raise error(
            f"{field}={name!r}: cannot be imported: {type(reason).__name__}: {reason}.{near} It "
            "must be module:function, with the module in the working directory or installed."
        ) from reason
    finally:
        sys.path.remove(folder)
