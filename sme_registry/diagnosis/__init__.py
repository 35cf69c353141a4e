"""The diagnosis of one run: where its regret sits, and what the evidence says about why."""

from sme_registry.diagnosis.diagnose import diagnose
from sme_registry.diagnosis.report import Diagnosis, Finding
from sme_registry.diagnosis.subject import Subject, of_cell, of_policy, of_run

__all__ = ["Diagnosis", "Finding", "Subject", "diagnose", "of_cell", "of_policy", "of_run"]
