"""Installed packages: their versions, and an error if an optional one is missing."""

from __future__ import annotations

import importlib.util
import platform
import sys
from collections.abc import Iterable, Mapping
from importlib import metadata

from sme_registry.errors import MissingDependencyError
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
    """Check that optional packages are installed; imports none of them.

    Args:
      purpose: what needs them, which the message begins with.
      packages: their full names by the name to import.
      extra: of this package, which installs them.

    Raises:
      MissingDependencyError: names the missing packages and the command that installs them.
    """
    missing = [name for package, name in packages.items() if not is_installed(package)]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise MissingDependencyError(
            f"{purpose}: {' and '.join(missing)} {verb} not installed. "
            f"Run `pip install 'sme-registry[{extra}]'`."
        )
