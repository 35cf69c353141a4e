"""`import_object`: import an object by the name `module:attribute`."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from sme_registry.errors import SMEError, did_you_mean


def import_object(name: str, field: str, error: type[SMEError]) -> Any:
    """Import an object by name. The working directory is searched first.

    Args:
      name: `module:attribute`. Importing a module runs its code.
      field: the argument that holds the name, for error messages.
      error: the type of error to raise.

    Raises:
      SMEError: of that type: the module or attribute does not exist, or importing it fails.
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
