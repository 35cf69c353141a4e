"""`rescore`: score submissions again and compare their verdicts and numbers with the board's.

The draw uses the system's randomness unless a seed repeats an earlier one: a forger who knew it
would alter other rows. It is from all results, rejections too, since a board may reject what it
does not like.

A normalised regret may differ by

    RESCORED                                  sums in another order: last bits of float32 actions
    2 mean |Δa| / mean |½ − a*|               a policy that amplifies them, as its twin shows

where |Δa| is the largest of several draws of all rounding errors (`artefact.twin`), over the very
states that are scored. The board's check bounds it only on average over random states, and a
submitter can choose a policy whose few sensitive states it misses. Such a difference is a note and
no proof of tampering. So is a verdict that depends on the machine or on chance, and a rejection by
other versions, whose checks may be others.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn

from leaderboard.documents.board import hex_of
from leaderboard.documents.result import Result, RunScore
from leaderboard.errors import TamperedError
from leaderboard.scoring.score import rounding_by_region, score_submission
from leaderboard.store import Store

RESCORED = 1e-5
"""Tolerance for new scores of the same policy: another machine or version of onnxruntime changes
its float32 actions by about 1e-7, and similar actions are divided by a regret as small as 0.1."""

_MARGIN = 2.0  # of other rounding errors than those drawn
_UNCERTAIN = (
    *("run_time", "run_memory", "scoring_failed"),
    *("run_batch_dependent", "run_rounding"),
)
"""Codes of rejections that depend on the machine or on random states."""

_OF_RUNTIME = ("run_failed", "onnx_refused")
"""Codes that depend on the runtime, but with the same versions on nothing else."""


@dataclass(frozen=True)
class RescoreNote:
    """A difference that does not prove tampering.

    Attributes:
      submission: its id.
      kind: "versions" of packages differ; "rounding" explains other numbers; a "verdict" that
        depends on the machine, on chance or on versions is another.
      where: the package or the run.
      recorded, here: the board's value and this machine's.
    """

    submission: str
    kind: Literal["versions", "rounding", "verdict"]
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
      TamperedError: the board's result is not what its policies score.
      ScoringFault: this machine cannot score it.
    """
    stored = store.result(id)
    assert stored is not None
    again = score_submission(store.document, store.submission(id).submission, store.objects.read)
    versions = list(_other_versions(stored, again))
    if (stored.status, stored.code) != (again.status, again.code):
        return [*versions, _other_verdict(stored, again, bool(versions))]
    return [*versions, *_other_numbers(store, stored, again)]


def _other_versions(stored: Result, again: Result) -> Iterator[RescoreNote]:
    for name, here in again.versions.items():
        recorded = stored.versions.get(name, "")
        if recorded != here:
            yield RescoreNote(stored.submission, "versions", name, recorded, here)


def _other_verdict(stored: Result, again: Result, other_versions: bool) -> RescoreNote:
    recorded, here = stored.code or "scored", again.code or "scored"
    uncertain = stored.code in _UNCERTAIN or again.code in _UNCERTAIN
    of_versions = stored.status == "rejected" or again.code in _OF_RUNTIME
    if not uncertain and not (of_versions and other_versions):
        _refuse(stored, f"scored again, it is {here}, not {recorded}. {again.message}".strip())
    return RescoreNote(stored.submission, "verdict", "code", recorded, here)


def _other_numbers(store: Store, stored: Result, again: Result) -> Iterator[RescoreNote]:
    for number, (new, old) in enumerate(zip(again.runs, stored.runs, strict=True)):
        differences = _differences(new, old)
        if max(differences) <= RESCORED:
            continue
        allowed = _allowed(store, new)
        for difference, most in zip(differences, allowed, strict=True):
            if difference > most:
                _refuse(
                    stored,
                    f"runs.{number}: scored again, it differs by {difference:.1e}: must be at most "
                    f"{most:.1e}, which rounding explains",
                )
        yield RescoreNote(
            stored.submission,
            "rounding",
            f"runs.{number}",
            f"differs by {max(differences):.1e}",
            f"rounding explains {max(allowed):.1e}",
        )


def _differences(new: RunScore, old: RunScore) -> list[float]:
    """The largest difference in each region, relative where a regret is above 1."""
    pairs = [
        (new.normalised_regret, old.normalised_regret),
        (new.similarity or (), old.similarity or ()),
        *(
            (one.normalised_regret, other.normalised_regret)
            for one, other in zip(new.agents, old.agents, strict=True)
        ),
    ]
    return [
        max(abs(x - y) / max(1.0, abs(x)) for x, y in of_region)
        for of_region in zip(*(zip(*pair, strict=True) for pair in pairs if pair[0]), strict=True)
    ]


def _allowed(store: Store, run: RunScore) -> list[float]:
    """The largest difference that rounding explains in each region."""
    assert run.spec is not None
    assert run.artefact is not None  # a failed run has no difference
    board = store.document
    _, spec = board.instances[run.spec]
    rounding = rounding_by_region(board, spec, store.objects.read(run.artefact), run.artefact)
    # An agent that owns one channel has the rounding of all channels, and not their mean.
    margin = _MARGIN * (spec.action_dim if run.agents else 1)
    return [RESCORED + margin * each for each in rounding]


def _refuse(stored: Result, message: str) -> NoReturn:
    raise TamperedError(f"results/{hex_of(stored.submission)}.json", message)
