"""`import_object`: import what `module:function` names."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from sme_registry.errors import SMEError, did_you_mean


def import_object(name: str, field: str, error: type[SMEError]) -> Any:
    """What `module:function` names; the module is looked for in this folder, too.

    Args:
      name: `module:function`. Importing a module runs it.
      field: what the name was given for, which a message begins with.
      error: the kind of error to raise.

    Raises:
      SMEError: of that kind: the module or its function is not there, or fails when it is imported.
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
            "must be module:function, the module in this folder or installed."
        ) from reason
    finally:
        sys.path.remove(folder)
