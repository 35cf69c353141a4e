"""A study's results as data frames, and its report: one page, figures and tables."""

from sme_registry.errors import MissingDependencyError

try:
    import pandas  # noqa: F401
except ImportError:
    raise MissingDependencyError(
        "The results of a study need pandas, which is not installed. "
        "Run `pip install 'sme-registry[studies]'`."
    ) from None
