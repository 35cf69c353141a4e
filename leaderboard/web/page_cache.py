"""`PageCache`: rendered files of the board's latest state."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from typing import NamedTuple

from leaderboard.store import Store
from leaderboard.web.site import Pages

PAGES_KEPT = 256


class CachedFile(NamedTuple):
    """A rendered file and its ETag."""

    content: bytes
    tag: str


class PageCache:
    """Rendered files, discarded when the log grows.

    One thread uses it at a time: rendering is bound by Python, and clients that ask at once for a
    page that is not cached wait for one rendering of it. It keeps at most `kept` files.
    """

    def __init__(self, store: Store, kept: int = PAGES_KEPT) -> None:
        self._store = store
        self._kept = kept
        self._head: object = None
        self._pages = Pages(store)
        self._files: OrderedDict[str, CachedFile] = OrderedDict()

    def get(self, name: str, render: Callable[[Pages], bytes]) -> CachedFile:
        """The file of this name, rendered if it is not cached."""
        head = self._store.head
        if head != self._head or not self._kept:
            self._head, self._pages = head, Pages(self._store)
            self._files.clear()
        if name not in self._files:
            content = render(self._pages)
            tag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
            self._files[name] = CachedFile(content, tag)
        file = self._files[name]
        self._files.move_to_end(name)
        if len(self._files) > self._kept:
            self._files.popitem(last=False)
        return file
