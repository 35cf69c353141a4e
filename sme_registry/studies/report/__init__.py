"""A study's results as data frames, and its report: one page, figures and tables."""

from sme_registry.io import require_packages

require_packages("the results of a study", {"pandas": "pandas"}, "studies")
