"""What dead processes and missing submissions leave behind, and how it is removed.

`collect_garbage` does so on request, `make_room` where a board is full.
"""

from __future__ import annotations

import datetime
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from leaderboard.documents.submission import shifted, utc
from leaderboard.store.files import unwritable
from leaderboard.store.index import Index
from leaderboard.store.store import Store
from sme_registry.io import TEMPORARY


@dataclass(frozen=True)
class Garbage:
    """What `collect_garbage` removed, or would remove.

    Attributes:
      temporary: number of half-written files of dead processes.
      objects: number of artefacts that no submission names.
      bytes: of all of them.
    """

    temporary: int
    objects: int
    bytes: int

    @property
    def files(self) -> int:
        """Number of files of both kinds."""
        return self.temporary + self.objects


def collect_garbage(
    store: Store,
    *,
    temporary_older_than: float = 3600.0,
    objects_older_than: float = 86400.0,
    dry_run: bool = False,
) -> Garbage:
    """Remove half-written files of dead processes and artefacts that no submission names.

    Args:
      temporary_older_than: seconds since a temporary file was last written to; a younger one may
        belong to an upload in progress.
      objects_older_than: seconds since an artefact was uploaded; the submission of a younger one
        may follow.
      dry_run: only count.

    Raises:
      BoardError: a file cannot be removed.
    """
    now = time.time()

    def is_older(path: Path, seconds: float) -> bool:
        return path.lstat().st_mtime <= now - seconds

    with store.transaction() as index:
        temporary = [
            path
            for path in store.folder.path.rglob(TEMPORARY)
            if path.is_file() and is_older(path, temporary_older_than)
        ]
        objects = {
            digest: path
            for digest, path in store.objects.paths()
            if is_older(path, objects_older_than)
            and index.one("SELECT 1 FROM object WHERE digest = ?", digest) is None
        }
        paths = [*temporary, *objects.values()]
        size = sum(path.lstat().st_size for path in paths)
        if not dry_run:
            for path in paths:
                _remove(path)
            for digest in objects:
                index.connection.execute("DELETE FROM upload WHERE digest = ?", (digest,))
            _forget_uploads_of_named_artefacts(index, objects_older_than)
    return Garbage(len(temporary), len(objects), size)


def make_room(store: Store, size: int, *, keep: str = "", older_than: float = 600.0) -> bool:
    """Remove artefacts that no submission names, until `size` more bytes fit onto the board.

    Whoever has neither a submission nor an entry on the board loses its uploads first, and then
    whoever has uploaded nothing for longest. An upload's age is that of its key's last one, so that
    a key that uploads many artefacts over a slow connection keeps the first of them.

    Args:
      store: the board.
      size: in bytes.
      keep: the public key of an uploader that loses nothing.
      older_than: seconds since a key's last upload; a submission may follow within that time.

    Returns:
      False if they do not fit; then nothing is removed.

    Raises:
      BoardError: a file cannot be removed.
    """
    limit = store.document.limits.total_bytes
    if store.total_bytes() + size <= limit:
        return True
    with store.transaction() as index:
        excess = store.total_bytes() + size - limit
        removed: set[tuple[str, str]] = set()
        files: list[str] = []
        uploads = index.connection.execute(_UNNAMED, (keep, *_outside(older_than))).fetchall()
        holders = Counter(digest for (digest,) in index.connection.execute(_HOLDERS))
        for digest, bytes_, key in uploads:
            if excess <= 0:
                break
            removed.add((digest, key))
            holders[digest] -= 1
            if holders[digest] == 0:
                files.append(digest)
                excess -= bytes_
        if excess > 0:
            return False
        for digest in files:
            _remove(store.folder.object(digest))
        index.connection.executemany("DELETE FROM upload WHERE digest = ? AND key = ?", removed)
    return True


_HOLDERS = "SELECT digest FROM upload WHERE digest NOT IN (SELECT digest FROM object)"
_UNNAMED = """
SELECT digest, size, upload.key FROM upload
JOIN (SELECT key, max(time) AS last FROM upload GROUP BY key) AS uploader USING (key)
WHERE digest NOT IN (SELECT digest FROM object) AND key <> ? AND NOT (last > ? AND last <= ?)
ORDER BY EXISTS (SELECT 1 FROM entry WHERE entry.key = upload.key)
  OR EXISTS (SELECT 1 FROM sealed WHERE sealed.key = upload.key), last, time, digest
"""


def _outside(seconds: float) -> tuple[str, str]:
    """Ends of the time in which an upload is young; it is not if its time is in the future."""
    moment = datetime.datetime.now(datetime.UTC)
    age = datetime.timedelta(seconds=seconds)
    return utc(shifted(moment, -age)), utc(shifted(moment, age))


def _forget_uploads_of_named_artefacts(index: Index, older_than: float) -> None:
    """Forget who else has the bytes of a submission's artefact, and has not submitted it."""
    index.connection.execute(
        "DELETE FROM upload WHERE digest IN (SELECT digest FROM object) "
        "AND NOT (time > ? AND time <= ?)",
        _outside(older_than),
    )


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
