"""The diagnosis of one run: where its regret is, and what the evidence says about why."""

from sme_registry.diagnosis.diagnose import diagnose
from sme_registry.diagnosis.document import Diagnosis, Verdict
from sme_registry.diagnosis.subject import Subject, load_cell, load_policy, load_run

__all__ = [
    "Diagnosis",
    "Subject",
    "Verdict",
    "diagnose",
    "load_cell",
    "load_policy",
    "load_run",
]
