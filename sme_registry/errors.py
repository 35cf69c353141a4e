"""Everything that `sme_registry` raises on bad input.

    SMEError
    ├── SpecError                 a document's field wrong, missing or unknown (also a ValueError)
    │   ├── MalformedDocumentError    not JSON at all, or not the JSON of this kind of document
    │   ├── DigestMismatchError       a file's digest is not that of its spec
    │   └── FingerprintMismatchError  a drawn task's numbers are not the published ones
    ├── UnknownNameError          no environment, suite, … of this name (also a LookupError)
    ├── NameTakenError            a released name would change its meaning
    ├── ResourceLimitError        the task would not fit in memory (also a MemoryError)
    ├── ActionError               an action of the wrong shape or not finite (also a ValueError)
    ├── StateError                a state of the wrong shape or out of bounds (also a ValueError)
    ├── EpisodeError              a step before `reset`, or after the end of an episode
    ├── WrapperError              an outer wrapper that would change the task
    ├── PolicyError               a policy that cannot be loaded, or whose actions cannot be used
    ├── OptionError               an argument or option outside its range (also a ValueError)
    └── MissingDependencyError    an optional package is needed and absent (also an ImportError)

A message says what was wrong, what was expected and what to do:
`hidden_width=0: must be in [1, 4096]. Leave it out for the default, 64.`
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SMEError(Exception):
    """Base of every error that this package raises on bad input."""


class SpecError(SMEError, ValueError):
    """A document's field is wrong, missing, unknown, or impossible beside another."""


class MalformedDocumentError(SpecError):
    """The text is not strict JSON, or not the JSON of this kind of document."""


class DigestMismatchError(SpecError):
    """A file carries a digest that is not the digest of its spec."""


class FingerprintMismatchError(SpecError):
    """A task drawn here has other numbers than the ones its file publishes."""


class UnknownNameError(SMEError, LookupError):
    """No environment, suite, protocol or algorithm of this name is known."""


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


class WrapperError(SMEError):
    """An outer wrapper would change the task, such as a time limit below the horizon."""


class PolicyError(SMEError):
    """A policy cannot be loaded, or does not return usable actions."""


class OptionError(SMEError, ValueError):
    """An argument or an option is outside its range."""


class MissingDependencyError(SMEError, ImportError):
    """An optional package is needed for this and is not installed."""


def near_misses(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """The known names nearest to a mistyped one, best first; case is ignored.

    Args:
      name: what was asked for.
      known: the names that exist.
      count: how many to return at most.

    Returns:
      Up to `count` names; empty if none is near.
    """
    by_fold = {candidate.casefold(): candidate for candidate in known}
    close = difflib.get_close_matches(name.casefold(), by_fold, n=count, cutoff=0.6)
    return [by_fold[fold] for fold in close]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`" Did you mean 'k'?"`, or an empty string where nothing is near."""
    close = near_misses(name, known)
    if not close:
        return ""
    return f" Did you mean {' or '.join(repr(candidate) for candidate in close)}?"
