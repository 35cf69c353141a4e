"""`sme study report`: what a study's folder shows, as one page, figures and tables."""

from sme_registry.studies.report.write import FORMATS, write_report

__all__ = ["FORMATS", "write_report"]
