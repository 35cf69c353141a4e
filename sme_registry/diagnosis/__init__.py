"""The diagnosis of one run: where its regret is, what the evidence says about why, who in a team is
to blame, and what a life in a stream forgot, never learnt or lost."""

from sme_registry.diagnosis.diagnose import AnyDiagnosis, diagnose
from sme_registry.diagnosis.document import Diagnosis, Verdict
from sme_registry.diagnosis.stream_document import StreamDiagnosis
from sme_registry.diagnosis.stream_subject import StreamSubject
from sme_registry.diagnosis.subject import (
    AnySubject,
    Subject,
    TeamSubject,
    load_cell,
    load_policy,
    load_run,
)
from sme_registry.diagnosis.team_document import TeamDiagnosis

__all__ = [
    "AnyDiagnosis",
    "AnySubject",
    "Diagnosis",
    "StreamDiagnosis",
    "StreamSubject",
    "Subject",
    "TeamDiagnosis",
    "TeamSubject",
    "Verdict",
    "diagnose",
    "load_cell",
    "load_policy",
    "load_run",
]
