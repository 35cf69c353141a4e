"""The pages of seasons: a list of them, and the page of each, before, during and after it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from leaderboard.documents.submission import Knowledge
from leaderboard.scoring.ranking import REASONS, RankedRow
from leaderboard.seasons.events import SealedRow, SeasonRow
from leaderboard.seasons.scoring import OfKey, by_key, counting, season_rankings
from leaderboard.seasons.season import SealedResult, Season
from leaderboard.seasons.store import SeasonStore
from leaderboard.web import charts
from leaderboard.web.pages import Pages, Section
from leaderboard.web.tables import setting_text

_CURVE_POINTS = 40


def _files(pages: Pages) -> dict[str, Callable[[], str]]:
    store = pages.store
    assert isinstance(store, SeasonStore)
    rows = store.seasons()
    if not rows:
        return {}
    files = {f"seasons/{row.id}.html": functools.partial(_page, pages, store, row) for row in rows}
    return {**files, "seasons.html": functools.partial(_list, pages, rows)}


SECTION = Section(("seasons.html", "Seasons"), Path(__file__).parent, _files)


def _list(pages: Pages, rows: list[SeasonRow]) -> str:
    return pages.render("seasons.html", here="seasons.html", title="Sealed seasons", rows=rows)


def _page(pages: Pages, store: SeasonStore, row: SeasonRow) -> str:
    page = season_page(store, row)
    # The scorer of the reference rows has scored the entries, too.
    if pages.preparing and any(page.rankings.values()):
        return pages.preparation("../")
    return pages.render(
        "season.html", here="", root="../", title=row.title, page=page, reasons=REASONS
    )


@dataclass(frozen=True)
class EntrantRow:
    """An entry or ticket in the table of a season."""

    row: SealedRow
    counts: bool  # a later entry of its key and method replaces it otherwise
    online_regret: float | None  # mean over the instances; None offline, and before its end
    curve: Markup  # of that over the budget, drawn; empty likewise


@dataclass(frozen=True)
class SeasonPage:
    row: SeasonRow
    season: Season
    settings: list[str]  # of each class, the fields that differ from a spec's defaults
    entrants: list[EntrantRow]
    rankings: dict[Knowledge, list[RankedRow]]  # by declared knowledge, of methods with results
    keys: dict[str, OfKey]  # how often each takes part
    master: str  # 64 hex digits after the reveal; empty before

    @property
    def online(self) -> bool:
        """Whether the server steps its tasks."""
        return self.row.track == "sealed-online"


def season_page(store: SeasonStore, row: SeasonRow) -> SeasonPage:
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


@functools.lru_cache(4096)  # results may have megabytes, and never change
def _stepped(store: SeasonStore, row: SealedRow) -> _Stepped:
    result = store.sealed_result(row)
    return _Stepped(_online_regret(result), _mean_curve(result))


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
