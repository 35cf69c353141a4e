"""The part of `verify` that is about sealed seasons: files that the log names, and signatures.

What follows from a reveal is replayed by `sealed.verify_season`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from leaderboard.documents.signed import Signed
from leaderboard.errors import TamperedError
from leaderboard.seasons.entry import Entry, SealedManifest, TicketRequest
from leaderboard.seasons.season import STEPPING, SeasonFolder
from leaderboard.store import Index, SealedRow, SeasonRow, read_document
from sme_registry.io import TEMPORARY

_HEX, _NUMBER = r"[0-9a-f]{64}", r"[1-9][0-9]*"
_FILES = (
    rf"({_HEX})/season\.json",
    rf"({_HEX})/reveal\.json",
    rf"({_HEX})/entries/({_HEX})\.json",
    rf"({_HEX})/results/({_HEX})\.json",
    rf"({_HEX})/tickets/({_NUMBER})/ticket\.json",
)
_OTHERS = rf"{_HEX}/(tickets/{_NUMBER}/.+|{re.escape(STEPPING)})"
"""Journals and answers, which `sealed.verify_season` replays, and the lock of a server."""


def count_unlogged_of_seasons(index: Index) -> int:
    """Check that no file passes for one of a season; count those about to be logged.

    Raises:
      TamperedError: a file is none of a board.
    """
    root, unlogged = index.folder.seasons, 0
    for path in _files(root):
        name = path.relative_to(root).as_posix()
        matches = [re.fullmatch(pattern, name) for pattern in _FILES]
        found = next((match for match in matches if match is not None), None)
        if found is None and re.fullmatch(_OTHERS, name) is None:
            raise TamperedError(f"{root.name}/{name}", "is not a file of a board")
        if found is not None and not _is_logged(index, name, *found.groups()):
            unlogged += 1
    return unlogged


def check_sealed_signatures(index: Index) -> tuple[int, int]:
    """Check the signatures of entries and requests, which the board's own key cannot forge.

    Returns:
      The number of seasons, and of their entries and tickets.

    Raises:
      TamperedError: names the first file whose signature does not match.
    """
    seasons = index.seasons.rows()
    count = 0
    for season in seasons:
        for row in index.seasons.entrants(season.digest):
            path, signed = _signed(index, season, row)
            if not signed.is_valid(index.document.signatures_for):
                where = path.relative_to(index.folder.path).as_posix()
                raise TamperedError(where, "its signature does not match the entrant's key")
            count += 1
    return len(seasons), count


def _signed(index: Index, season: SeasonRow, row: SealedRow) -> tuple[Path, Signed[SealedManifest]]:
    folder = SeasonFolder(index.folder, season.digest)
    if season.track == "sealed-online":
        path = folder.request(row.number)
        return path, read_document(index.folder, path, Signed[TicketRequest], row.document)
    path = folder.entry(row.entrant.id)
    return path, read_document(index.folder, path, Signed[Entry], row.document)


def _is_logged(index: Index, name: str, season: str, part: str = "") -> bool:
    """Whether the log names a file; `part` is the id's digits, or the number, in its path."""
    row = index.seasons.row(f"sha256:{season}")
    if row is None:
        return False
    if name.endswith("/season.json"):
        return True
    if name.endswith("/reveal.json"):
        return row.reveal is not None
    if name.endswith("/ticket.json"):
        return index.seasons.ticket(row.digest, int(part)) is not None
    entrant = index.seasons.entrant(f"sha256:{part}")
    if entrant is None or entrant.season != row.digest:
        return False
    return "/entries/" in name or entrant.result is not None


def _files(root: Path) -> Iterator[Path]:
    """All files below a folder, in order, without half-written ones."""
    if root.is_dir():
        yield from (
            path
            for path in sorted(root.rglob("*"))
            if not path.is_dir() and not path.match(TEMPORARY)
        )
