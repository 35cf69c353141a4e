"""`rescore`: score submissions again and compare their verdicts and numbers with the board's.

The draw uses the system's randomness unless a seed repeats an earlier one: a forger who knew it
would alter other rows. It is from all results, rejections too, since a board may reject what it
does not like.

Other numbers, or another verdict, mean that this machine does not confirm the entry. They are no
proof of tampering: other processors and versions of libraries round otherwise, and the gate bounds
what that does only on average. Whoever repeats it on another machine learns which it is.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from leaderboard.documents.result import Result, RunScore
from leaderboard.scoring.score import score_submission
from leaderboard.store import Store

RESCORED = 1e-5
"""Tolerance for new scores of the same policy: another machine or version of onnxruntime changes
its float32 actions by about 1e-7, and similar actions are divided by a regret as small as 0.1."""


@dataclass(frozen=True)
class RescoreNote:
    """A difference to the board's result.

    Attributes:
      submission: its id.
      kind: "versions" of packages differ, which proves nothing; the "numbers" of a run or the
        "verdict" differ, and so the entry is not confirmed here.
      where: the package or the run.
      recorded, here: the board's value and this machine's.
    """

    submission: str
    kind: Literal["versions", "numbers", "verdict"]
    where: str
    recorded: str
    here: str


def draw(ids: Sequence[str], count: int | Literal["all"], seed: int) -> list[str]:
    """The submissions to score again, in the order of `ids`."""
    if count == "all" or count >= len(ids):
        return list(ids)
    drawn = set(random.Random(seed).sample(ids, count))
    return [id for id in ids if id in drawn]


def rescore(store: Store, id: str) -> list[RescoreNote]:
    """Score a submission again, through gate, sandbox and evaluation, and compare.

    Raises:
      ScoringFault: this machine cannot score it.
    """
    stored = store.result(id)
    assert stored is not None
    again = score_submission(store.document, store.submission(id).content, store.objects.read)
    notes = [
        RescoreNote(id, "versions", name, recorded, again.versions[name])
        for name, recorded in stored.versions.items()
        if recorded != again.versions.get(name, recorded)
    ]
    recorded, here = stored.code or "scored", again.code or "scored"
    if recorded != here:
        return [*notes, RescoreNote(id, "verdict", "code", recorded, here)]
    return [*notes, *_other_numbers(stored, again)]


def _other_numbers(stored: Result, again: Result) -> Iterator[RescoreNote]:
    for number, (new, old) in enumerate(zip(again.runs, stored.runs, strict=True)):
        difference = max(
            (abs(x - y) / max(1.0, abs(x)) for x, y in _pairs(new, old)),
            default=0.0,
        )
        if difference > RESCORED:
            yield RescoreNote(
                stored.submission,
                "numbers",
                f"runs.{number}",
                f"differs by {difference:.1e}",
                f"at most {RESCORED:g} expected",
            )


def _pairs(new: RunScore, old: RunScore) -> Iterator[tuple[float, float]]:
    """The numbers of each region, new and old."""
    yield from zip(new.normalised_regret, old.normalised_regret, strict=True)
    yield from zip(new.similarity or (), old.similarity or (), strict=True)
    for one, other in zip(new.agents, old.agents, strict=True):
        yield from zip(one.normalised_regret, other.normalised_regret, strict=True)
