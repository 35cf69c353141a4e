"""What the pages of sealed seasons show: terms and commitments, entrants, rankings, curves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from leaderboard.documents.result import SealedResult
from leaderboard.documents.season import Season
from leaderboard.documents.submission import Knowledge
from leaderboard.scoring.memo import Memo
from leaderboard.scoring.ranking import RankedRow
from leaderboard.scoring.season import OfKey, by_key, counting, season_rankings
from leaderboard.store import SealedRow, SeasonRow, Store
from leaderboard.web.site import charts
from leaderboard.web.site.rows import setting_text

_CURVE_POINTS = 40


@dataclass(frozen=True)
class EntrantRow:
    """An entry or ticket in the table of a season.

    Attributes:
      row: its row of the index.
      counts: whether it counts; a later entry of its key and method replaces it otherwise.
      online_regret: mean over the instances; None offline, and before its end.
      curve: of that over the budget, drawn; empty likewise.
    """

    row: SealedRow
    counts: bool
    online_regret: float | None
    curve: Markup


@dataclass(frozen=True)
class SeasonPage:
    """All that the page of a season shows.

    Attributes:
      settings: of each class, the fields that differ from a spec's defaults.
      rankings: by declared knowledge, of methods with results.
      keys: how often each key takes part.
      master: 64 hex digits after the reveal; empty before.
    """

    row: SeasonRow
    season: Season
    settings: list[str]
    entrants: list[EntrantRow]
    rankings: dict[Knowledge, list[RankedRow]]
    keys: dict[str, OfKey]
    master: str

    @property
    def online(self) -> bool:
        """Whether the server steps its tasks."""
        return self.row.track == "sealed-online"


def season_page(store: Store, row: SeasonRow) -> SeasonPage:
    """What is public of a season now."""
    season = store.season(row.digest)
    counted = {each.entrant.id for each in counting(store, season)}
    rows = store.entrants(row.digest)
    stepped = [_stepped(store, each) for each in rows]
    curves = [each.curve for each in stepped if each.curve]
    drawn = iter(charts.sparklines(curves, "From the first step"))
    entrants = [
        EntrantRow(
            row=each,
            counts=each.entrant.id in counted,
            online_regret=of.regret,
            curve=next(drawn) if of.curve else Markup(""),
        )
        for each, of in zip(rows, stepped, strict=True)
    ]
    return SeasonPage(
        row=row,
        season=season,
        settings=[setting_text(member.setting) for member in season.classes],
        entrants=entrants,
        rankings=season_rankings(store, season, "wd_regret"),
        keys=by_key(store, season),
        master=store.revealed_master(row.digest).raw.hex() if row.reveal else "",
    )


class _Stepped(NamedTuple):
    """What the table shows of a ticket's steps; nothing offline, and before its end."""

    regret: float | None
    curve: list[float]


_STEPPED: Memo[_Stepped] = Memo(4096)  # results may have megabytes, and never change


def _stepped(store: Store, row: SealedRow) -> _Stepped:
    if row.result is None:
        return _Stepped(None, [])

    def read() -> _Stepped:
        result = store.sealed_result(row)
        return _Stepped(_online_regret(result), _mean_curve(result))

    return _STEPPED.get(row.result, read)


def _online_regret(result: SealedResult | None) -> float | None:
    if result is None or not result.stepping:
        return None
    return float(np.mean([each.normalised_online_regret for each in result.stepping]))


def _mean_curve(result: SealedResult | None) -> list[float]:
    """The mean learning curve over the instances, at equal shares of their budgets."""
    if result is None or not result.stepping:
        return []
    share = np.linspace(0.0, 1.0, _CURVE_POINTS)
    curves = [each.learning_curve for each in result.stepping]
    values = [np.interp(share, np.linspace(0.0, 1.0, len(curve)), curve) for curve in curves]
    mean: list[float] = np.mean(values, axis=0).tolist()
    return mean
