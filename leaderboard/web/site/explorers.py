"""Explorers of submitted policies: a page for each run, which computes its network in the browser.

A stranger's network reaches a page as numbers only, through `artefact.network`; what is not
understood in full is left out, and its page shows the task alone.
"""

from __future__ import annotations

from leaderboard.artefact.gate import widths
from leaderboard.artefact.network import network_of
from sme_registry import SMESpec
from sme_registry.diagnosis import load_policy
from sme_registry.errors import OptionError, PolicyError, ResourceLimitError
from sme_registry.explorer import STATIC, check_size, explorer_page, facts

__all__ = ["STATIC", "can_show", "explorer"]

_STATIC = "../static/"
_UNKNOWN = (
    "This page cannot compute the network of this policy. It shows the task, with a linear and a "
    "constant policy."
)


def can_show(spec: SMESpec) -> bool:
    """Whether a task is small enough for a page."""
    try:
        check_size(spec)
    except (OptionError, ResourceLimitError):
        return False
    return True


def explorer(name: str, data: bytes, spec: SMESpec) -> str:
    """The page of a policy.

    Args:
      name: what the page calls it; any text.
      data: its ONNX file.
      spec: a task of which `can_show` is true.
    """
    network = network_of(data, *widths(spec))
    if network is not None:
        try:
            subject = load_policy(network, spec, action_range="unit", name=name)
            return explorer_page(facts(subject), _STATIC)
        except PolicyError:  # its actions are not finite
            pass
    return explorer_page(facts(spec, remark=_UNKNOWN), _STATIC)
