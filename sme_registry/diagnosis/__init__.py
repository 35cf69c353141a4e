"""The diagnosis of one run: where its regret is, what the evidence says about why, who in a team is
to blame, and what a life in a stream forgot, never learnt or lost."""

from sme_registry.diagnosis.diagnose import diagnose
from sme_registry.diagnosis.document import Diagnosis, TaskDiagnosis, Verdict
from sme_registry.diagnosis.stream import StreamDiagnosis
from sme_registry.diagnosis.subject import (
    AnySubject,
    StreamSubject,
    Subject,
    load_cell,
    load_policy,
    load_run,
)
from sme_registry.diagnosis.team import TeamDiagnosis

__all__ = [
    "AnySubject",
    "Diagnosis",
    "StreamDiagnosis",
    "StreamSubject",
    "Subject",
    "TaskDiagnosis",
    "TeamDiagnosis",
    "Verdict",
    "diagnose",
    "load_cell",
    "load_policy",
    "load_run",
]
