"""The results of tickets that are over: `score_ticket`, `unplayed_result`.

An instance without answers scores 1 in every metric, whatever its steps.

    normalised online regret = Σ regret / Σ regret of the constant ½ in the same states

over the budget, and over each part of it. Steps that were not taken count like the constant's: what
took a share f of its steps, with the ratio q, has f q + 1 − f. Steps at the end of the budget into
which no request of all lanes fits cannot be taken, and do not count.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from leaderboard.scoring.aggregation import failed_run
from leaderboard.seasons.journal import Journal
from leaderboard.seasons.master import Master
from leaderboard.seasons.scoring import score_run, sealed_result
from leaderboard.seasons.season import SealedResult, Season, Stepping
from leaderboard.seasons.stepping import Lanes, Start
from leaderboard.seasons.ticket import RunningTicket
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
        answers, digest = instance.stored_answers
        run, used = score_run(ticket.hidden(index), answers, digest, store.document.rules)
        runs.append(run)
        versions |= used
        steps = measured_steps(ticket.start(index), instance.journal, instance.budget)
        stepping.append(steps.model_copy(update={"signed": instance.signed_digest}))
    document = store.document
    return sealed_result(
        season, row.entrant.id, runs, versions, document.draws, stepping, document.rules
    )


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


MOST_PARTS = 100
Array = npt.NDArray[np.float64]


def measured_steps(start: Start, journal: Journal | None, budget: int) -> Stepping:
    """Replay a journal, and measure its regret.

    Args:
      start: of the instance.
      journal: of its steps; None if the instance was never started.
      budget: steps that could be taken, over all lanes.
    """
    if journal is None:
        return no_steps(budget)
    lanes = Lanes(start, journal.lanes)
    requests = budget // journal.lanes
    parts = min(MOST_PARTS, requests)
    sums = np.zeros((parts, 3))  # regret, that of the constant ½, requests
    for request, actions in enumerate(journal.actions()):
        _, regret = lanes.step_with_regret(actions)
        sums[request * parts // requests] += (*regret, 1.0)
    firsts = -(np.arange(parts + 1) * -requests // parts)  # request of each part
    return Stepping(
        steps=journal.steps,
        normalised_online_regret=_ratio(sums.sum(axis=0), requests),
        learning_curve=tuple(map(_ratio, sums, np.diff(firsts))),
    )


def no_steps(budget: int, lanes: int = 1) -> Stepping:
    """The regret of an instance that took no steps; `lanes` is 1 before the start."""
    curve = (1.0,) * min(MOST_PARTS, budget // lanes)
    return Stepping(steps=0, normalised_online_regret=1.0, learning_curve=curve)


def _ratio(sums: Array, possible: int) -> float:
    """Regret relative to the constant's, from `sums` of both and of the requests taken."""
    regret, half, taken = map(float, sums)
    share = taken / float(possible)
    # The constant has no regret only where π* is ½ throughout, and so has none either.
    return share * (regret / half if half > 0.0 else 0.0) + 1.0 - share
