"""The errors that `sme_registry` raises on invalid input.

    SMEError
    ├── SpecError (ValueError): StreamError, UnexpectedKeywordError (TypeError),
    │   MalformedDocumentError, DigestMismatchError, FingerprintMismatchError
    ├── ActionError, StateError, OptionError, NameTakenError, WireError (all ValueError)
    ├── UnknownNameError (LookupError), ResourceLimitError (MemoryError),
    │   MissingDependencyError (ImportError), EpisodeError (RuntimeError)
    ├── PolicyError
    └── SealedError: BudgetSpentError

A message gives the field, its value, the allowed range and the fix:
`hidden_width=0: must be in [1, 4096]. Correct it, or leave it out for the default, 64.`
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SMEError(Exception):
    """Base of every error that this package raises on invalid input.

    Examples:
      >>> try:
      ...     sme_registry.load("Defualt")
      ... except sme_registry.SMEError as error:
      ...     print(type(error).__name__)
      UnknownNameError
    """


class SpecError(SMEError, ValueError):
    """A field of a document is invalid, missing, unknown, or conflicts with another."""


class StreamError(SpecError):
    """A stream was given where a single task is needed."""


class UnexpectedKeywordError(SpecError, TypeError):
    """A keyword is neither an argument of the environment nor a field of its spec.

    A TypeError in Python's words, since frameworks try arguments and go on after that error.
    """


class MalformedDocumentError(SpecError):
    """The text is not strict JSON, or not the JSON of this kind of document."""


class DigestMismatchError(SpecError):
    """The digest in a file is not the digest of its spec."""


class FingerprintMismatchError(SpecError):
    """The numbers drawn on this machine differ from those that the file publishes."""


class UnknownNameError(SMEError, LookupError):
    """No environment, suite, protocol or algorithm has this name."""


class NameTakenError(SMEError, ValueError):
    """A name is in use for another spec; a released id never changes its numbers."""


class ResourceLimitError(SMEError, MemoryError):
    """Materialising the task would take more memory than the limit."""


class ActionError(SMEError, ValueError):
    """An action has the wrong shape or is not finite."""


class StateError(SMEError, ValueError):
    """A state has the wrong shape, is not finite, or lies outside the unit cube."""


class EpisodeError(SMEError, RuntimeError):
    """`step` was called before `reset`, or after the episode had ended."""


class PolicyError(SMEError):
    """A policy cannot be loaded, or does not return usable actions."""


class OptionError(SMEError, ValueError):
    """An argument or an option is outside its range."""


class WireError(SMEError, ValueError):
    """A message between a sealed season's server and a client has a wrong size or form."""


class SealedError(SMEError):
    """A board's server refused a request, or gives no answer.

    Its `code` is the board's; "unreachable", "http" or "wire" where it sent none; "transcript"
    where it has sent or taken something else than this program knows.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message

    def __reduce__(self) -> tuple[type[SealedError], tuple[str, str]]:
        return type(self), (self.code, self.message)


class BudgetSpentError(SealedError):
    """A ticket has no steps left on this instance."""


class MissingDependencyError(SMEError, ImportError):
    """An optional package is required and not installed."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`" Did you mean 'k'?"`, up to three similar names; empty if there are none. Ignores case.

    Initials are similar: `lr` and `learning_rate`.
    """
    by_fold = {candidate.casefold(): candidate for candidate in known}
    fold = name.casefold()
    close = difflib.get_close_matches(fold, by_fold, n=3, cutoff=0.6) or [
        each for each in by_fold if "".join(word[:1] for word in each.split("_")) == fold
    ]
    if not close:
        return ""
    return f" Did you mean {' or '.join(repr(by_fold[each]) for each in close[:3])}?"
