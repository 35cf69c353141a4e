"""`Interface`: the widths of observations and actions that a task needs of a policy."""

from __future__ import annotations

from typing import NamedTuple


class Interface(NamedTuple):
    """What a policy must map from and to.

    Attributes:
      observation_dim: entries of an observation.
      action_dim: entries of an action.
      description: what these widths belong to, such as "state_dim=3, action_dim=2".
      alternatives: other forms that are allowed, for the error message.
      hint: see `Policy`.
    """

    observation_dim: int
    action_dim: int
    description: str
    alternatives: str = ""
    hint: str = ""
