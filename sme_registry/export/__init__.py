"""Policies as ONNX files, which `sme evaluate` runs and leaderboards accept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sme_registry.export.export import export_onnx, onnx_bytes

__all__ = ["export_onnx", "onnx_bytes"]


def __getattr__(name: str) -> Any:
    if name in __all__:  # a leaderboard needs only the list of operators
        from sme_registry.export import export

        return getattr(export, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
