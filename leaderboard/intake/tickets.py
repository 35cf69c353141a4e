"""Requests for tickets of sealed-online seasons: read, checked, then started in the signed log.

The answer to a request has the ticket's password, and a board keeps requests where others may read
them. So a request is sent with a header `Authorization` as for an upload of the request's id, whose
signature is at most ten minutes old, and nobody else can repeat it.

A ticket starts only where the board has room for all steps of its budget, so that it can take them.
"""

from __future__ import annotations

import datetime

from leaderboard.documents.checks import check_board, check_names, check_time
from leaderboard.documents.entry import SignedTicketRequest
from leaderboard.documents.submission import Envelope
from leaderboard.errors import Rejection
from leaderboard.intake.admission import check_daily_quota, check_name
from leaderboard.intake.uploads import check_room, uploader
from leaderboard.store import Store, played_bytes


def refuse_other_sender(
    store: Store, envelope: Envelope[SignedTicketRequest], header: str | None
) -> None:
    """Reject a request that its own key has not just sent.

    Args:
      store: the board.
      envelope: the request.
      header: the value of `Authorization`; None if there is none.

    Raises:
      Rejection: `bad_signature`, `wrong_board` or `stale_time`.
    """
    sender = uploader(header, envelope.id, board=store.document.key)
    if sender != envelope.key:
        raise Rejection(
            "bad_signature",
            f"Authorization: is signed by the key {sender[:16]}…: must be by {envelope.key[:16]}…, "
            "which signed the request. Sign both with one key.",
        )


def start_ticket(
    store: Store,
    envelope: Envelope[SignedTicketRequest],
    season: str,
    at: datetime.datetime | None = None,
) -> tuple[int, bool]:
    """Start a ticket; the same request starts no second one, and has its number again.

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
    if request.answers_key is None:
        raise Rejection(
            "schema",
            "ticket.answers_key: missing: must be the public key that will sign the answers. "
            "Create the request with `sme-leaderboard ticket`.",
        )
    check_names(request, store.document.key)
    moment = at or datetime.datetime.now(datetime.UTC)
    check_time(request.created, moment, store.document.limits.age_days)
    size = len(signed.to_bytes()) + played_bytes(store.season(season))
    with store.transaction():  # no other entrant can take the name, or the room, in between
        check_name(store, request.submitter)
        check_daily_quota(store, request.submitter.key, moment)
        check_room(store, size)
        return store.start_ticket(signed), True
