"""The results of tickets that are over: `score_ticket`, `unplayed_result`.

An instance without answers scores 1 in every metric, whatever its steps.
"""

from __future__ import annotations

from leaderboard.documents.master import Master
from leaderboard.documents.result import SealedResult
from leaderboard.documents.season import Season
from leaderboard.scoring.metrics import failed_run
from leaderboard.scoring.sealed import score_run, sealed_result
from leaderboard.sealed.regret import measured_steps, no_steps
from leaderboard.sealed.ticket import RunningTicket
from leaderboard.store import Store


def score_ticket(store: Store, season: Season, master: Master, number: int) -> SealedResult:
    """Score a ticket from its journals and answers.

    Args:
      store: the board.
      season, master: the season.
      number: the ticket's; nothing of it may change any more.

    Raises:
      Rejection: `ticket_unknown`, or `storage_full` if a file cannot be read.
      TamperedError: a journal, or answers, are not those of the instance.
    """
    row = store.ticket(season.digest, number)
    ticket = RunningTicket(store, season, master, row)
    runs, stepping = [], []
    versions: dict[str, str] = {}
    for index, instance in enumerate(ticket.instances):
        run, used = score_run(ticket.hidden(index), *instance.stored_answers)
        runs.append(run)
        versions |= used
        steps = measured_steps(ticket.start(index), instance.journal, instance.budget)
        stepping.append(steps.model_copy(update={"signed": instance.signed_digest}))
    draws = store.document.draws
    return sealed_result(season, row.entrant.id, runs, versions, draws, stepping)


def unplayed_result(store: Store, season: Season, ticket: RunningTicket) -> SealedResult:
    """What `score_ticket` computes for a ticket without steps and answers, and at no cost.

    Args:
      store: the board.
      season: the ticket's.
      ticket: is unplayed.
    """
    subject = store.ticket(season.digest, ticket.number).entrant.id
    runs = [failed_run(season.protocol, hidden.member.name, None) for hidden in season.hidden]
    stepping = [no_steps(each.budget, each.lanes or 1) for each in ticket.instances]
    return sealed_result(season, subject, runs, {}, store.document.draws, stepping)
