"""Documents: what is frozen, hashed and shared."""

from sme_registry.spec.envelope import EnvFile, Fingerprint, ProtocolFile, SuiteFile
from sme_registry.spec.protocol import EvaluationProtocol
from sme_registry.spec.sme_spec import AgentSpec, SMESpec, TeamSpec, as_spec
from sme_registry.spec.suite import Suite, SuiteClass

__all__ = [
    "AgentSpec",
    "EnvFile",
    "EvaluationProtocol",
    "Fingerprint",
    "ProtocolFile",
    "SMESpec",
    "Suite",
    "SuiteClass",
    "SuiteFile",
    "TeamSpec",
    "as_spec",
]
