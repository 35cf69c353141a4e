"""Policies as ONNX files, which `sme evaluate` runs and leaderboards accept."""

from sme_registry.export.export import FEED_FORWARD, export_onnx, onnx_bytes

__all__ = ["FEED_FORWARD", "export_onnx", "onnx_bytes"]
