"""Installed packages: their versions, whether they are installed, and objects in them by name."""

from __future__ import annotations

import importlib.util
import os
import platform
import sys
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

from sme_registry.errors import MissingDependencyError, SMEError, did_you_mean
from sme_registry.version import __version__


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


def require_packages(purpose: str, packages: Mapping[str, str], extra: str) -> None:
    """Check that optional packages, full names by the name to import, are installed.

    Raises:
      MissingDependencyError: names the purpose, the missing packages, and the command that installs
        them, with this extra of our package.
    """
    missing = [name for package, name in packages.items() if not is_installed(package)]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise MissingDependencyError(
            f"{purpose}: {' and '.join(missing)} {verb} not installed. "
            f"Run `pip install 'sme-registry[{extra}]'`."
        )


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
