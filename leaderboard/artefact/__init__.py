"""Artefacts: policies as ONNX files, from their bytes to their actions."""
