"""Requests for tickets of sealed-online seasons: read, checked, then started in the signed log."""

from __future__ import annotations

import datetime

from leaderboard.documents.checks import check_board, check_names, check_time
from leaderboard.documents.entry import SignedTicketRequest
from leaderboard.documents.submission import Envelope
from leaderboard.errors import Rejection
from leaderboard.intake.admission import check_name
from leaderboard.intake.uploads import check_room
from leaderboard.store import Store


def start_ticket(
    store: Store,
    envelope: Envelope[SignedTicketRequest],
    season: str,
    at: datetime.datetime | None = None,
) -> tuple[int, bool]:
    """Start a ticket; the same request starts no second one, and has its number again.

    Whoever has a signed request learns its ticket's password. So no page, and no copy of a board
    that is made public while tickets run, may contain one.

    Args:
      store: the board.
      envelope: the request, its signature verified and its content not validated.
      season: digest of the season that it was sent to.
      at: time of arrival; now by default.

    Returns:
      The ticket's number, and whether it is new.

    Raises:
      Rejection: with the code of the first fault.
    """
    check_board(store.document, envelope.board)
    known = store.entrant(envelope.id)
    if known is not None and known.season == season:
        return known.number, False
    signed = envelope.open()
    request = signed.ticket
    if request.season != season:
        raise Rejection(
            "season_unknown",
            f"season={request.season}: the request was sent to the season {season}. Send it to "
            "its own.",
        )
    check_names(request, store.document.key)
    moment = at or datetime.datetime.now(datetime.UTC)
    check_time(request.created, moment, store.document.limits.age_days)
    with store.transaction():  # no other entrant can take the name in between
        check_name(store, request.submitter)
        check_room(store, request.submitter.key, len(signed.to_bytes()))
        return store.start_ticket(signed), True
