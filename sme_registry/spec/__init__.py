"""Documents: specs, suites, protocols and plans, frozen and hashed, and their files."""

from sme_registry.spec.document import (
    Digest,
    Document,
    Integer,
    Name,
    Real,
    SchemaVersion,
    StrictModel,
    TupleOf,
)
from sme_registry.spec.envelope import (
    EnvFile,
    Fingerprint,
    ProtocolFile,
    StreamFile,
    StudyFile,
    SuiteFile,
)
from sme_registry.spec.protocol import EvaluationProtocol, ProtocolLike
from sme_registry.spec.sme_spec import (
    ACTION_RANGES,
    ActionRange,
    AgentSpec,
    ObservationSpec,
    SafetySpec,
    Setting,
    SMESpec,
    SpecLike,
    TeamSpec,
    as_spec,
)
from sme_registry.spec.stream import Drift, Phase, Piece, StreamLike, StreamSpec, as_stream
from sme_registry.spec.study import Cell, PlannedCell, StudyAlgorithm, StudyPlan
from sme_registry.spec.suite import StreamClass, Suite, SuiteClass

__all__ = [
    "ACTION_RANGES",
    "ActionRange",
    "AgentSpec",
    "Cell",
    "Digest",
    "Document",
    "Drift",
    "EnvFile",
    "EvaluationProtocol",
    "Fingerprint",
    "Integer",
    "Name",
    "ObservationSpec",
    "Phase",
    "Piece",
    "PlannedCell",
    "ProtocolFile",
    "ProtocolLike",
    "Real",
    "SMESpec",
    "SafetySpec",
    "SchemaVersion",
    "Setting",
    "SpecLike",
    "StreamClass",
    "StreamFile",
    "StreamLike",
    "StreamSpec",
    "StrictModel",
    "StudyAlgorithm",
    "StudyFile",
    "StudyPlan",
    "Suite",
    "SuiteClass",
    "SuiteFile",
    "TeamSpec",
    "TupleOf",
    "as_spec",
    "as_stream",
]
