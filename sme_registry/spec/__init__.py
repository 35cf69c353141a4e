"""Documents: specs, suites, protocols and plans, frozen and hashed, and their files."""

from sme_registry.spec.blocks import (
    AgentSpec,
    NoiseSpec,
    ObservationSpec,
    SafetySpec,
    ShapingSpec,
    TeamSpec,
)
from sme_registry.spec.files import EnvFile, ProtocolFile, StreamFile, StudyFile, SuiteFile
from sme_registry.spec.sme_spec import Setting, SMESpec
from sme_registry.spec.stream import Drift, Phase, StreamSpec
from sme_registry.spec.study import StudyAlgorithm, StudyPlan
from sme_registry.spec.suite import EvaluationProtocol, StreamClass, Suite, SuiteClass

__all__ = [
    "AgentSpec",
    "Drift",
    "EnvFile",
    "EvaluationProtocol",
    "NoiseSpec",
    "ObservationSpec",
    "Phase",
    "ProtocolFile",
    "SMESpec",
    "SafetySpec",
    "Setting",
    "ShapingSpec",
    "StreamClass",
    "StreamFile",
    "StreamSpec",
    "StudyAlgorithm",
    "StudyFile",
    "StudyPlan",
    "Suite",
    "SuiteClass",
    "SuiteFile",
    "TeamSpec",
]
