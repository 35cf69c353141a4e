"""The words of findings: a sentence for each question and verdict, and the parts of sentences."""

from __future__ import annotations

import math
import string
from collections.abc import Iterator, Mapping
from typing import Any

from sme_registry.diagnosis.questions import THRESHOLDS as DIAGNOSIS
from sme_registry.io.markup import fixed, plural, signed
from sme_registry.studies.report.analysis import ENOUGH_RUNS
from sme_registry.studies.report.tables import OFFLINE_INTERVAL

THRESHOLDS = {
    "unlearnt": DIAGNOSIS["unlearnt"],  # normalised regret, at least: almost nothing was learnt
    "broken": 0.2,  # change of normalised regret, at least
    "hurt": 0.05,  # at least; a smaller one hurts slightly
    "probability": 0.5,  # of improvement, for the better of two algorithms
    "enough_runs": float(ENOUGH_RUNS),  # with fewer runs or pairs a change is an indication
    "interval_runs": float(OFFLINE_INTERVAL),  # with fewer an improvement has no interval
    "near": 0.02,  # difference of r̃, at most: as good as
    "collapse": 0.1,  # of r̃ below the behaviour policy, at least
}

Found = Iterator[dict[str, Any]]

_RISES = "on {class_name} its WD regret rises from {base:.} to {level:.}, by {change}."
_SURE = "The interval shows that it hurts"
_DATA = "its data at {places}, by {by}."
SENTENCES = {
    "contrasts": {
        "none": "{algorithm} has no contrasts yet: no run on the first class, {first}, has a run "
        "of the same number on another class.",
    },
    "first class": {
        "unlearnt": "{algorithm} has learnt almost nothing on the first class: its WD regret there "
        "is {value:.}, and the constant action's is 1. What was not learnt cannot break, so the "
        "contrasts need a longer budget.",
    },
    "worst": {
        "broken": "{algorithm} is broken{most} by {property}: " + _RISES,
        "hurt": "{algorithm} is hurt{most} by {property}: " + _RISES,
        "slightly_hurt": "{algorithm} is hurt slightly{comma}{most} by {property}: " + _RISES,
        "none_shown": "No class was shown to make {algorithm} worse within distribution. That does "
        "not show that none does.",
    },
    "larger": {"open": "Larger still, but not certain: {listed}."},
    "highest": {"open": "The highest end of an interval is {value:+}."},
    "single": {
        "open": "A single pair of runs has no interval; the largest change of such a pair is "
        "{value:+} ({class_name})."
    },
    "certainty": {
        "indication": "This is an indication, not a finding: it rests on {pairs} of runs, and "
        "{enough} would be enough.",
        "rivals": f"{_SURE}, but not that it hurts most: the intervals allow a larger change by "
        "{listed}.",
        "only_axis": f"{_SURE}; no other axis was varied.",
        "certain": "It is the worst of the axes varied here: its interval begins at {low:+}, above "
        "the end of every other axis.",
    },
    "position": {
        "worse_than_constant": "At {value:.} it is worse than the constant action ½, which has 1.",
        "like_constant": "At {value:.} it is about as good as the constant action ½, which has 1.",
        "worse_than_linear": "At {value:.} it is better than the constant action ½, which has 1, "
        "and worse than the linear policy fitted to the optimum, which has {linear:.}.",
        "better_than_linear": "At {value:.} it is better than the constant action ½, which has 1, "
        "and better than the linear policy fitted to the optimum, which has {linear:.}.",
    },
    "linear policy": {
        "harder_to_fit": "The linear policy had {base:.} on the first class, so the optimum itself "
        "is harder to fit."
    },
    "other axes": {
        "worse": "Also worse by {listed}.",
        "indication": "There are indications that it is made worse by {listed}.",
        "open": "Not shown to make it worse: {listed}. A wide interval means too few runs.",
        "better": "Its WD regret is lower than on the first class with {listed}.",
    },
    "out of distribution": {
        "worse": "Out of distribution, {property} {costs}: {listed}.",
    },
    "training steps": {"differ": "Training steps differ: {listed}."},
    "best": {
        "best": "Over the {classes} on which all have runs,{data} {algorithm} is best within "
        "distribution: {value:.}{interval}, where 1 is the optimum and 0 the constant ½."
    },
    "rival": {
        "better": "One of its runs beats one of {other} with probability {value:.}{interval}.",
        "indication": "One of its runs beats one of {other} with probability {value:.}{interval}, "
        "an indication from few runs.",
        "open": "One of its runs beats one of {other} with probability {value:.}{interval}, so "
        "either may be better.",
    },
    "missing runs": {
        "missing": "{missing} of {planned} are missing{failed}. No number includes them; the table "
        "of runs lists them."
    },
    "few runs": {
        "few": "Some numbers rest on {pairs}. The 95 % bootstrap interval of 2 runs covers the "
        "truth in only 32–62 % of cases, of 3 runs in 48–86 %, depending on their distribution, "
        "and of 4 or more in 94–98 %. With fewer than {enough}, this report calls a change an "
        "indication at most."
    },
    "chance": {
        "expected": "There are {intervals} contrasts within distribution, each with its own "
        "interval. If nothing had an effect, about {value:n} of them would exclude 0 by chance."
    },
    "policy_init": {
        "differs": "The policy_init of {listed} also differs from the first class’s, as deep tasks "
        "require. The contrasts include its effect."
    },
    "example": {
        "nu": "An algorithm here is a learner with its data: {algorithm} learnt from data of "
        "ν = {value:g}. The behaviour policy that makes the data takes (1 − α) a* + α ã, where α "
        "is drawn from U(0, ν) at each step and ã is the action of a second network."
    },
    "behaviour": {
        "near": "The behaviour policies are close to 1 − ν/6 everywhere. The largest difference is "
        "{value:+3} ({where}).",
        "far": "The behaviour policies are close to 1 − ν/6 in {near} of {count} cases, but not at "
        "{places}. A single second network may be closer to the optimum, or further away, than "
        "independent uniform actions are. The largest difference is {value:+3} ({where}).",
    },
    "imitation": {
        "imitates": "{algorithm} imitates: its mean is close to the behaviour policy's everywhere. "
        "The largest difference is {value:+3} ({where}).",
        "near_at_some": "{algorithm} is close to the behaviour policy at {places}. The largest "
        "difference is {value:+3} ({where}).",
        "near_at_none": "{algorithm} is close to the behaviour policy nowhere. The largest "
        "difference is {value:+3} ({where}).",
    },
    "improvement": {
        "above": f"It surpasses {_DATA}",
        "above_few": f"There are indications (all of few runs) that it surpasses {_DATA}",
        "below": f"It falls behind {_DATA}",
        "below_few": f"There are indications (all of few runs) that it falls behind {_DATA}",
        "single_above": f"A single run, which is only a hint, is above {_DATA}",
        "none": "It was not shown to surpass its data at any ν.",
        "open": "Whether it is above or below its data is open at {places}.",
    },
    "depth": {
        "no_runs": "{algorithm} has no finished run on the deepest class, {class_name}.",
        "holds": "{algorithm} does not collapse on the deepest class, {class_name} ({nus} of ν, "
        "{count}): its mean is more than {near} above that of the constant ½ everywhere; compared "
        "with its data, it is {value:+3} at the lowest ({where}).",
        "collapses": "{algorithm} collapses on the deepest class, {class_name} ({nus} of ν, "
        "{count}): {how}.{few}",
    },
    "offline runs": {
        "few": "Each learner has {count} per class and ν. “Close” means within {near} of r̃. With "
        "fewer than {enough} runs a result is an indication at most, and with fewer than "
        "{interval_runs} it has no interval.",
        "enough": "Each learner has {count} per class and ν. “Close” means within {near} of r̃. "
        "Each result rests on its own interval, and one in twenty intervals excludes 0 by chance.",
    },
    "forgets": {
        "forgets": "In {class_name}, {algorithm} forgets{most}: at the end of the life, "
        "performance on earlier phases is {value:.} below its best{interval}.",
        "indication": "In {class_name}, there are indications that {algorithm} forgets{most}: at "
        "the end of the life, performance on earlier phases is {value:.} below its best{interval}.",
        "none": "In {class_name}, no algorithm forgets: the largest value, that of {algorithm}, is "
        "{value:.}{interval}.",
        "unlearnt": "In {class_name}, no algorithm has learnt enough to forget: each has learnt "
        "almost nothing in its visits.",
        "open": "In {class_name}, no algorithm was shown to forget, and none was shown not to. The "
        "largest value is that of {algorithm}, {value:.}{interval}.",
        "single_visit": "In {class_name} each life has a single visit, so there is nothing to "
        "forget.",
    },
    "largest forgetting": {
        "open": "The largest value, that of {algorithm}, is open: {value:.}{interval}."
    },
    "forgets more": {
        "more": "{algorithm} forgets more than {other}: by {value:+}{interval}.",
        "indication": "{algorithm}’s value is larger than that of {other}, an indication of few "
        "pairs: by {value:+}{interval}.",
        "open": "{algorithm}’s value is the largest, but {other} may forget more: the difference "
        "is {value:+}{interval}.",
    },
    "life": {
        "learnt": "{algorithm} ({lives}): at the end of a visit its normalised regret on the phase "
        "is {value:.}.",
        "unlearnt": "{algorithm} ({lives}): at the end of a visit its normalised regret on the "
        "phase is {value:.}. It has learnt almost nothing, so it has little to forget and hardly "
        "any plasticity to lose.",
    },
    "forgetting": dict.fromkeys(
        ("above", "below", "open"), "Forgetting of {algorithm}: {value:.}{interval}."
    ),
    "plasticity": {
        "above": "Plasticity: {algorithm} loses plasticity{few}{than_fresh}.",
        "below": "Plasticity: {algorithm} learns more than a fresh agent{few}{than_fresh}.",
        "open": "Plasticity: for {algorithm} no loss of plasticity was shown, and none excluded"
        "{than_fresh}.",
        "unknown": "Plasticity: that of {algorithm} is unknown, since no life has all of its fresh "
        "agents.",
        "single_visit": "Plasticity: a life of one visit is a fresh agent itself.",
    },
    "forward transfer": {
        "above": "{algorithm} is better than before training on phases before their first visit"
        "{few}: forward transfer is {value:+}{interval}.",
        "below": "{algorithm} is worse than before training on phases before their first visit"
        "{few}: forward transfer is {value:+}{interval}.",
        "open": "Whether {algorithm} is better or worse than before training on phases before "
        "their first visit is open: forward transfer is {value:+}{interval}.",
    },
    "fresh agents": {
        "missing": "{lives} not all of their fresh agents yet: no number on plasticity or learning "
        "transfer includes them."
    },
    "relatedness": {
        "related": "The streams differ in their tasks alone. The phases of {class_name} are "
        "rotations of one task, those of {first} are not, so the changes from {first} are those "
        "that relatedness makes.",
        "other": "{class_name} differs from {first} in its tasks alone.",
    },
    "change": {
        "better": "{algorithm}: {metric} is better, {change}.",
        "worse": "{algorithm}: {metric} is worse, {change}.",
        "better_few": "{algorithm}: {metric} is better, an indication from few pairs, {change}.",
        "worse_few": "{algorithm}: {metric} is worse, an indication from few pairs, {change}.",
        "open": "{algorithm}: {metric} is open, since the interval contains 0 or is unknown, "
        "{change}.",
    },
    "draws": {
        "repeat": "Several lives of an algorithm share a draw of their stream. They are not "
        "independent draws of the tasks, so the intervals are too narrow for other draws."
    },
}


class _Words(string.Formatter):
    """Numbers as `{x:.}` with two decimals, `{x:+}` with a sign, and `{x:+3}` with three."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec.startswith("+"):
            return signed(value, int(format_spec[1:] or 2))
        return fixed(value) if format_spec == "." else format(value, format_spec)


def sentence(words: Mapping[str, Any]) -> str:
    """What a finding says: `words` are its question, its verdict, and the names in braces."""
    return _Words().vformat(SENTENCES[words["question"]][words["verdict"]], (), words)


def finding(
    section: str,
    question: str,
    verdict: str,
    *,
    algorithm: str = "",
    class_name: str = "",
    value: float = math.nan,
    low: float = math.nan,
    high: float = math.nan,
    runs: int | None = None,
    **words: Any,
) -> dict[str, Any]:
    row = {
        "section": section, "algorithm": algorithm, "class_name": class_name, "question": question,
        "verdict": verdict, "value": value, "low": low, "high": high, "runs": runs,
    }  # fmt: skip
    return row | {"sentence": sentence(row | words)}


def few_runs(section: str, fewest: int, one: str, many: str) -> dict[str, Any]:
    return finding(
        section, "few runs", "few", runs=fewest, pairs=plural(fewest, one, many),
        enough=plural(ENOUGH_RUNS, one, many),
    )  # fmt: skip


def missing_runs(section: str, missing: int, planned: int, failed: int) -> Found:
    if missing:
        yield finding(
            section, "missing runs", "missing", value=missing, missing=f"{missing:,}",
            planned=plural(planned, "run"),
            failed=f", {failed:,} of them because they failed" if failed else "",
        )  # fmt: skip


def numbers_of(row: Any) -> dict[str, Any]:
    """The columns of a finding that a row of any table has."""
    names = {"value": ("change", "iqm", "improvement"), "runs": ("pairs", "runs")}
    numbers = {"class_name": row.class_name, "low": row.low, "high": row.high}
    if hasattr(row, "metric") and hasattr(row, "iqm"):
        numbers["algorithm"] = row.algorithm
    for column, candidates in names.items():
        numbers[column] = next(getattr(row, name) for name in candidates if hasattr(row, name))
    return numbers


def change_text(row: Any) -> str:
    """The change of a row with its interval and the number of pairs."""
    if math.isnan(row.low):
        return f"{signed(row.change)}, a single pair, no interval"
    ends = f"95 % interval {signed(row.low)} to {signed(row.high)}"
    return f"{signed(row.change)}, {ends}, {plural(row.pairs, 'pair')}"


def lives_text(row: Any) -> str:
    if math.isnan(row.low):
        return " (a single life, no interval)"
    ends = f"95 % interval {fixed(row.low)} to {fixed(row.high)}"
    return f" ({ends}, {plural(row.runs, 'life', 'lives')})"


def ends_text(row: Any) -> str:
    return between(row.low, row.high)


def between(low: float, high: float, value: float = 0.0) -> str:
    return "" if math.isnan(low) else f" ({fixed(low)} to {fixed(high)})"
