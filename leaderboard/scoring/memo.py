"""`Memo`: what follows from files that never change, computed once."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Memo(Generic[Value]):
    """Values by the digests of the files from which they follow.

    Args:
      most: the largest number kept; the oldest is forgotten.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: dict[Hashable, Value] = {}

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made if it is not known. Threads may make one twice."""
        try:
            return self._values[key]
        except KeyError:
            value = make()
        self._values[key] = value
        for oldest in list(self._values)[: max(0, len(self._values) - self._most)]:
            self._values.pop(oldest, None)
        return value
