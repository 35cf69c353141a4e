"""The diagnosis of one run: where its regret is, what the evidence says about why, and who in a
team is to blame."""

from sme_registry.diagnosis.diagnose import diagnose
from sme_registry.diagnosis.document import Diagnosis, Verdict
from sme_registry.diagnosis.subject import Subject, TeamSubject, load_cell, load_policy, load_run
from sme_registry.diagnosis.team_document import TeamDiagnosis

__all__ = [
    "Diagnosis",
    "Subject",
    "TeamDiagnosis",
    "TeamSubject",
    "Verdict",
    "diagnose",
    "load_cell",
    "load_policy",
    "load_run",
]
