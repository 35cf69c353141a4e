"""`sealed_result`: from the runs of a sealed entry or ticket to its scores.

    challenge states  the observations that `sme_registry.evaluate` shows to a policy under the
                      season's protocol, with the seed of the instance's secret
    score of a run    that of a policy that returns the entrant's answers, in the same order

So scores are those of the open board, and there is no second scorer.
"""

from __future__ import annotations

from collections.abc import Sequence

from leaderboard.documents.board import RULES
from leaderboard.documents.result import RunScore, SealedResult, Stepping
from leaderboard.documents.season import Season
from leaderboard.scoring.aggregation import Groups, class_score, is_oracle_like, method_scores


def sealed_result(
    season: Season,
    subject: str,
    runs: Sequence[RunScore],
    versions: dict[str, str],
    draws: int,
    stepping: Sequence[Stepping] = (),
) -> SealedResult:
    """The result of scored runs: θ, intervals and flags.

    Args:
      season: its classes.
      subject: id of the entry, or of the request for the ticket.
      runs: one on each hidden instance, in the season's order.
      versions: of packages.
      draws: number of bootstrap resamples, the board's.
      stepping: online, of each run.
    """
    groups = groups_of_season(season, [runs])
    scores = method_scores(groups, draws, season.digest)
    return SealedResult(
        season=season.digest,
        subject=subject,
        scores=scores,
        classes=tuple(class_score(name, members) for name, members in groups.items()),
        runs=tuple(runs),
        stepping=tuple(stepping),
        oracle_like=is_oracle_like(scores, RULES, runs),
        versions=versions,
    )


def groups_of_season(season: Season, entrants: Sequence[Sequence[RunScore]]) -> Groups:
    """The runs of a method by class, each in a group of its own: no two are on the same instance.

    Args:
      season: its classes.
      entrants: the runs of each entry or ticket, one on each hidden instance, in order.
    """
    groups: Groups = {member.name: {} for member in season.classes}
    for number, runs in enumerate(entrants):
        for hidden, run in zip(season.hidden, runs, strict=True):
            name = hidden.member.name
            groups[name][f"{name}/{number}/{hidden.instance}"] = [run]
    return groups
