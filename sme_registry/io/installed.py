"""`versions`: what is installed of the packages that numbers depend on."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable
from importlib import metadata

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
