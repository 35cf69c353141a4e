"""What dead processes and missing submissions leave behind, and how it is removed.

`collect_garbage` does so on request; uploads without a submission expire by themselves.
"""

from __future__ import annotations

import datetime
import time
from dataclasses import dataclass
from pathlib import Path

from leaderboard.documents.submission import shifted, utc
from leaderboard.store.files import unwritable
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
    return Garbage(len(temporary), len(objects), size)


def expire_uploads(store: Store) -> None:
    """Remove uploads of more than an hour ago that no submission of their key has named.

    Raises:
      BoardError: a file cannot be removed.
    """
    moment = datetime.datetime.fromisoformat(store.time)
    until = utc(shifted(moment, -datetime.timedelta(seconds=_UNNAMED_SECONDS)))
    with store.transaction() as index:
        old = index.connection.execute(
            "DELETE FROM upload WHERE time <= ? RETURNING digest", (until,)
        ).fetchall()
        for (digest,) in old:
            if index.one(_IS_HELD, digest) is None:
                _remove(store.folder.object(digest))


_UNNAMED_SECONDS = 3600.0
_IS_HELD = "SELECT 1 FROM object WHERE digest = ?1 UNION ALL SELECT 1 FROM upload WHERE digest = ?1"


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
