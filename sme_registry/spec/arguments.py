"""Types of the arguments that name a task or say how to act in it."""

from __future__ import annotations

import os
from typing import Any, Literal, TypeAlias, get_args

from sme_registry.spec.protocol import EvaluationProtocol
from sme_registry.spec.sme_spec import SMESpec

SpecLike: TypeAlias = SMESpec | dict[str, Any] | str | os.PathLike[str]
"""A task: its spec, the spec's fields, an id, a digest or a path; see `resolve`."""

ProtocolLike: TypeAlias = EvaluationProtocol | dict[str, Any] | str | os.PathLike[str]
"""A protocol: itself, its fields, its name in the catalogue, or the path of its file."""

ActionRange: TypeAlias = Literal["unit", "symmetric"]
"""The range of actions: [0, 1], the paper's, or [−1, 1], which Stable-Baselines3 prefers."""

ACTION_RANGES: tuple[str, ...] = get_args(ActionRange)
