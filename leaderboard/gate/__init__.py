"""Strangers' policy files, read and run in a confined process, and the reference policies."""
