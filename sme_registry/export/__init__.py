"""Policies as ONNX files, which `sme evaluate` runs and leaderboards accept."""

from sme_registry.export.export import export_onnx, onnx_bytes

__all__ = ["export_onnx", "onnx_bytes"]
