"""Entries and requests for tickets of sealed seasons: read, checked, then stored in the signed log.

The answers come first, as uploads of the entrant's key. Nothing is scored before the reveal.

The answer to a request for a ticket has the ticket's password, and a board keeps requests where
others may read them. So a request is sent with a header `Authorization` as for an upload, whose
signature is at most ten minutes old, and nobody else can repeat it.
"""

from __future__ import annotations

import datetime

from leaderboard.admission import (
    ReadFile,
    check_entrant,
    check_manifest,
    check_stored,
    uploader,
)
from leaderboard.documents.board import check_receiver
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import Artefact
from leaderboard.errors import Rejection
from leaderboard.seasons.entry import Entry, TicketRequest
from leaderboard.seasons.events import played_bytes
from leaderboard.seasons.season import Season, read_answers
from leaderboard.seasons.store import SeasonStore


def receive_entry(store: SeasonStore, signed: Signed[Entry], season: str, address: str) -> bool:
    """Admit an entry that a server at an address received for the season of this digest."""
    if signed.content.season != season:
        raise Rejection(
            "season_unknown",
            f"season={signed.content.season}: the entry was sent to the season {season}. Send "
            "it to its own.",
        )
    return enter(store, signed, address=address)


def enter(
    store: SeasonStore,
    signed: Signed[Entry],
    answers: ReadFile | None = None,
    address: str | None = None,
) -> bool:
    """Check an entry, its signature verified, and store it; False if the board has it.

    Args:
      store, signed: the board and the entry.
      answers: returns the bytes of an answer by digest; they are stored with the entry. By default
        the entrant's key has uploaded them.
      address: of the server that it was sent to; None if it was given to the board's folder.
    """
    check_receiver(store.document, signed.receiver, address)
    if store.entrant(signed.id) is not None:
        return False
    entry, key = signed.content, signed.content.submitter.key
    check_manifest(store.document, entry, datetime.datetime.fromisoformat(store.time))
    store.open_season(entry.season, "sealed-offline", key)
    season = store.season(entry.season)
    given = _check_answers(store, season, signed, answers)
    with store.transaction():  # no other entrant can take the name, nor `gc` an answer in between
        check_entrant(store, entry.submitter, len(signed.to_bytes()))
        _check_newest(store, season, entry)
        for answer in given:
            if answers is not None:
                store.put_object(answer.sha256, [answers(answer.sha256)], by=key)
            check_stored(store, key, answer)
        return store.enter(signed)


def _check_newest(store: SeasonStore, season: Season, entry: Entry) -> None:
    """Refuse an entry that would not count, as its key has signed a later one of its method."""
    own = entry.submitter.key, entry.method.name.casefold()
    for row in store.entrants(season.digest):
        if row.method == own and row.created > entry.created:
            raise Rejection(
                "stale_time",
                f"created={entry.created}: entry {row.number} of the same key and method was "
                f"signed later, at {row.created}. The one signed last counts: check your clock, "
                "and sign this one again.",
            )


def _check_answers(
    store: SeasonStore, season: Season, signed: Signed[Entry], read: ReadFile | None
) -> list[Artefact]:
    """The answers that are not null, each in the shape of its instance's challenge."""
    entry, hidden = signed.content, list(season.hidden)
    if len(entry.answers) != len(hidden):
        raise Rejection(
            "answer_missing",
            f"answers: has {len(entry.answers)}: must have {len(hidden)}, one for each instance of "
            f"the season {season.id}, null where the method failed.",
        )
    given, checked = [], set()
    for number, (answer, each) in enumerate(zip(entry.answers, hidden, strict=True)):
        if answer is None:
            continue
        if read is None:
            check_stored(store, entry.submitter.key, answer)
        # Many instances may have the same answers, which are read once for each shape.
        form = answer.sha256, each.member.setting.action_dim
        try:
            if form not in checked:
                data = (read or store.objects.read)(answer.sha256)
                read_answers(data, each.member.setting, season.protocol)
                checked.add(form)
        except Rejection as error:
            where = f"answers.{number} (class {each.member.name}, instance {each.instance})"
            raise Rejection(error.code, f"{where}: {error.message}") from None
        given.append(answer)
    return given


def refuse_other_sender(
    store: SeasonStore, signed: Signed[TicketRequest], header: str | None, address: str
) -> None:
    """Reject a request whose header does not show that its own key has just sent it, here."""
    sender = uploader(store.document, header, signed.id, address)
    key = signed.content.submitter.key
    if sender != key:
        raise Rejection(
            "bad_signature",
            f"Authorization: is signed by the key {sender[:16]}…: must be by {key[:16]}…, "
            "which signed the request. Sign both with one key.",
        )


def start_ticket(
    store: SeasonStore,
    signed: Signed[TicketRequest],
    season: str,
    address: str | None = None,
) -> tuple[int, bool]:
    """Start a ticket of the season to which a request was sent: its number, and whether it is new.

    The same request starts no second one. `address` is as in `enter`.
    """
    check_receiver(store.document, signed.receiver, address)
    known = store.entrant(signed.id)
    if known is not None and known.season == season:
        return known.number, False
    request = signed.content
    if request.season != season:
        raise Rejection(
            "season_unknown",
            f"season={request.season}: the request was sent to the season {season}. Send it to "
            "its own.",
        )
    if request.answers_key is None or request.transcript is None:
        raise Rejection(
            "schema",
            "ticket.answers_key, ticket.transcript: missing: must be the public key that signs the "
            "transcripts, and 1. Create the request with `sme-leaderboard ticket`.",
        )
    check_manifest(store.document, request, datetime.datetime.fromisoformat(store.time))
    size = len(signed.to_bytes()) + played_bytes(store.season(season))
    with store.transaction():  # no other entrant can take the name, or the room, in between
        check_entrant(store, request.submitter, size)
        return store.start_ticket(signed), True
