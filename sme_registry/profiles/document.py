"""`Profile`: where an algorithm breaks along `AXES`, as facts, and what follows from them.

It is a study, whose plan is `profile-v1` with the one algorithm: the default and two harder levels
of each of nine axes, with some draws of each.

    N₀          WD regret: 0 for the optimum, 1 for the constant ½; a level's is the IQM over draws
    1 − N₀      performance
    robustness  of an axis: mean over its harder levels of  (1 − N₀ there) / (1 − N₀ at its base),
                what is kept of the performance; unknown where N₀ at the base is at least `UNLEARNT`
    N₀ ≤ ½      at the first evaluation during training in whose episodes the mean |a − a*| is at
                most half of that of the constant ½

Intervals are the 95 % bootstrap intervals of `statistics` over draws. Two algorithms are compared
in pairs: on the same draw of a level with the same seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from sme_registry.io.markup import Table, card, conjunction, fixed, plural, signed, table_html
from sme_registry.spec import StudyAlgorithm, StudyFile, catalogue
from sme_registry.spec.document import Digest, Integer, Real, StoredModel, StrictModel, TupleOf
from sme_registry.spec.study import PlannedCell
from sme_registry.statistics import Array, Statistic, iqm
from sme_registry.studies.report.analysis import ENOUGH_RUNS, Bootstrap
from sme_registry.studies.report.design import METRICS
from sme_registry.studies.report.findings import THRESHOLDS
from sme_registry.studies.report.tables import paired
from sme_registry.studies.result import CellResult

COMPARED = "PPO", "TD3", "SAC"  # in sentences, by default; others are in figures and tables
DEFAULT, TWO_LAYERS = "default", "complexity-2"
REFERENCES = Path(__file__).parent / "references"
UNLEARNT = THRESHOLDS["unlearnt"]
DIGITS = 6
_HALF = 0.5
_NAMED = 3  # axes, in one sentence


class Axis(NamedTuple):
    """What its levels change, and they by the names of their classes, the base first."""

    label: str
    levels: Mapping[str, str]

    @property
    def base(self) -> str:
        return next(iter(self.levels))

    @property
    def harder(self) -> list[str]:
        return [*self.levels][1:]


def _axis(label: str, stem: str, values: str, base: str = DEFAULT) -> Axis:
    first, *harder = values.split()
    names = {f"{stem}-{value.replace('.', '_')}": value for value in harder}
    return Axis(label, {base: first, **names})


AXES = (
    _axis("state dimension S", "state_dim", "8 16 64"),
    _axis("action dimension A", "action_dim", "4 8 16"),
    _axis("reward interval k", "k", "1 5 25"),
    _axis("reward threshold r_min", "r_min", "0 0.5 0.75"),
    _axis("survival threshold D", "D", "0 0.25 0.5"),
    _axis("complexity L", "complexity", "1 2 10"),
    _axis("foresight, scale of shaping", "shaping-scale", "0 10 30", TWO_LAYERS),
    _axis("noise of the reward σ", "noise-reward", "0 0.3 1", TWO_LAYERS),
    _axis("distractors", "observation-distractors", "0 8 32"),
)


def plan_file() -> StudyFile:
    return catalogue.find(StudyFile, "profile")


class ProfileRow(StrictModel):
    """A finished run; numbers have six decimals.

    Attributes:
      class_name: the level, a class of the plan.
      run: the number of the draw, from 0, which is also the seed of training.
      wd_regret: N₀.
      ood_regret: N̄, the mean of normalised regret over the shells around the cube.
      ood_decay: the share of similarity that is lost in the shells.
      online_regret: mean over all steps of training; null of what does not train.
      evaluations: during training, at its end included.
      steps_to_half: steps before the first evaluation with N₀ ≤ ½; null if there was none.
    """

    class_name: str
    run: Integer
    wd_regret: Real
    ood_regret: Real
    ood_decay: Real
    online_regret: Real | None
    evaluations: Integer
    steps_to_half: Integer | None


class ProfileFailure(StrictModel):
    """A run that raised an error, by its level and the number of its draw."""

    class_name: str
    run: Integer
    error: str


class DrawEstimate(NamedTuple):
    """A number over draws with its 95 % interval; NaN where it is unknown.

    A difference of N₀ of two algorithms is over pairs of runs, with the verdict on the first.
    """

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan
    draws: int = 0
    verdict: str = ""

    def __str__(self) -> str:
        if not self.draws:
            return "–"
        text = signed if self.verdict else fixed
        ends = "" if math.isnan(self.low) else f" [{text(self.low)}, {text(self.high)}]"
        return text(self.value) + ends


class Profile(StoredModel):
    """Where an algorithm breaks: its regret on the default and on harder levels of nine axes.

    `print(profile)` shows a row for each axis, `profile.sentences()` compares it with the reference
    algorithms, and its page is in the folder of `sme_registry.profile`.

    Attributes:
      schema_version: version of the format.
      algorithm: what was trained; its name is that of the profile.
      plan: the name of the plan of levels and draws.
      plan_digest: its digest; profiles of one plan and as many steps can be compared.
      protocol_digest: of the evaluation in and outside the cube.
      steps: of training, in each run.
      seeds: draws of each level.
      classes: the levels that were asked for.
      rows: finished runs.
      failures: runs that failed.
      versions: of the packages that the numbers depend on.

    Examples:
      >>> from sme_registry import Profile
      >>> ppo = Profile.references()["PPO"]
      >>> ppo.level("default").value < ppo.level("noise-reward-1").value
      True
    """

    schema_version: Literal[1] = 1
    algorithm: StudyAlgorithm
    plan: str
    plan_digest: Digest
    protocol_digest: Digest
    steps: Integer
    seeds: Integer
    classes: TupleOf[str]
    rows: TupleOf[ProfileRow]
    failures: TupleOf[ProfileFailure] = ()
    versions: dict[str, str]

    @classmethod
    def references(cls) -> dict[str, Self]:
        """The profiles that the package has, by name: PPO first."""
        known = {profile.name: profile for profile in map(cls.read, REFERENCES.glob("*.json"))}
        order = [algorithm.name for algorithm in plan_file().plan.algorithms]
        return {name: known[name] for name in sorted(known, key=order.index)}

    @property
    def name(self) -> str:
        return self.algorithm.name

    def comparable(self, others: Iterable[Profile]) -> list[Profile]:
        """Those with the same levels, draws and steps, without another of the same algorithm.

        One of the same name, such as ours of a PPO of Stable-Baselines3, is "reference PPO".
        """
        mine = self.algorithm.uses, self.algorithm.hyperparameters
        return [
            other._named(f"reference {other.name}") if other.name == self.name else other
            for other in others
            if other.plan_digest == self.plan_digest
            and (other.steps == self.steps or not other.learns)
            and (other.algorithm.uses, other.algorithm.hyperparameters) != mine
        ]

    def _named(self, name: str) -> Self:
        algorithm = self.algorithm.model_copy(update={"name": name})
        return self.model_copy(update={"algorithm": algorithm})

    @property
    def learns(self) -> bool:
        return self.algorithm.steps != 0

    def values(self, class_name: str, field: str = "wd_regret") -> dict[int, float]:
        """A number of each run on a level that has it, by run."""
        rows = (row for row in self.rows if row.class_name == class_name)
        numbers = {row.run: getattr(row, field) for row in rows}
        return {run: value for run, value in numbers.items() if value is not None}

    def level(self, class_name: str, field: str = "wd_regret") -> DrawEstimate:
        """The IQM over the draws of a level."""
        values = self.values(class_name, field)
        runs = np.array([[value] for value in values.values()])
        return self._estimate(runs, iqm, "level", class_name, field)

    def robustness(self, axis: Axis, within: Iterable[str] | None = None) -> DrawEstimate:
        """What is kept of the performance at the harder levels, over draws that have all levels.

        `within` has the levels that count, such as those of a quick profile; by default all.
        """
        asked = {*self.classes} if within is None else {*self.classes}.intersection(within)
        levels = [self.values(name) for name in axis.levels if name in asked]
        known = axis.base in asked and len(levels) > 1
        draws = sorted(set[int].intersection(*map(set, levels))) if known else []
        runs = np.array([[of_level[draw] for of_level in levels] for draw in draws])
        if draws and float(iqm(runs)[0]) >= UNLEARNT:
            runs = runs[:0]
        return self._estimate(runs, _kept, "robustness", *axis.levels)

    def _estimate(self, runs: Array, statistic: Statistic, *place: str) -> DrawEstimate:
        if not len(runs):
            return DrawEstimate()
        bootstrap = Bootstrap(self.plan_digest)
        ends = bootstrap.interval({"": runs}, "profile", *place, statistic=statistic)
        return DrawEstimate(float(statistic(runs)[0]), *ends, len(runs))

    def steps_to_half(self, class_name: str = DEFAULT) -> float | None:
        """The median over draws; infinite where it was not reached, None if it is unknown."""
        steps = self._steps_to_half(class_name)
        return float(np.quantile(steps, 0.5, method="higher")) if steps else None

    def _steps_to_half(self, class_name: str) -> list[float]:
        """Of each draw; none if it does not learn, or was evaluated at its end alone."""
        rows = [row for row in self.rows if row.class_name == class_name]
        if not self.learns or any(row.evaluations < 2 for row in rows):
            return []
        return [math.inf if row.steps_to_half is None else row.steps_to_half for row in rows]

    def contrasts(self, other: Profile) -> dict[str, DrawEstimate]:
        """The differences on the default, and over the harder levels of each axis, by label."""
        places = {"the default": [DEFAULT]} | {axis.label: axis.harder for axis in AXES}
        known = {label: self._against(other, names) for label, names in places.items()}
        return {label: difference for label, difference in known.items() if difference.draws}

    def _against(self, other: Profile, names: Sequence[str]) -> DrawEstimate:
        pairs = {}
        for name in names:
            ours, theirs = self.values(name), other.values(name)
            if draws := sorted(ours.keys() & theirs.keys()):
                pairs[name] = np.array([[ours[draw], theirs[draw]] for draw in draws])
        if not pairs:
            return DrawEstimate()
        place = "profile", other.name, *pairs
        *_, value, low, high, count, _, verdict = paired(
            pairs, METRICS["wd_regret"], Bootstrap(self.plan_digest), *place
        )
        return DrawEstimate(value, low, high, count, verdict)

    def sentences(self, others: Iterable[Profile] | None = None) -> list[str]:
        """Where it breaks, how fast it learns, and where it is better or worse than PPO, TD3, SAC.

        `others` are the profiles it is compared with, by default these three references.
        """
        if others is None:
            known = self.references()
            others = (known[name] for name in COMPARED if name in known)
        said = map(self._comparison, self.comparable(others))
        return [*self._breaks(), self._speed(), *filter(None, said)]

    def _breaks(self) -> list[str]:
        kept = {axis.label: self.robustness(axis) for axis in AXES}
        kept = {label: each for label, each in kept.items() if not math.isnan(each.value)}
        if not kept:
            return [self._no_robustness()]
        least, *others = sorted(kept, key=lambda label: kept[label].value)
        text = f"{self.name} breaks most along {least}: it keeps {kept[least]} of its performance."
        near = [label for label in others if kept[label].low <= kept[least].high]
        if near:
            text += f" Its interval overlaps with those along {_listed(near, kept)}."
        if others:
            text += f" It is hurt least along {others[-1]}: {kept[others[-1]]}."
        few = min(each.draws for each in kept.values()) < ENOUGH_RUNS
        return [
            f"{text} With fewer than {ENOUGH_RUNS} draws this is an indication." if few else text
        ]

    def _no_robustness(self) -> str:
        if self.level(DEFAULT).value >= UNLEARNT:
            text = f"On the default {self.name} is hardly better than the constant ½, or worse"
            return f"{text}: no robustness is known."
        return f"No robustness of {self.name} is known: no axis has runs of one draw on all levels."

    def _speed(self) -> str:
        text = f"On the default its N₀ is {self.level(DEFAULT)}"
        if not self.learns:
            return f"{text}; it does not learn."
        text, half = f"{text} after {self.budget}", self.steps_to_half()
        if half is None:
            return f"{text}; when it fell to ½ is unknown, as it was evaluated at the end alone."
        if math.isinf(half):
            steps = self._steps_to_half(DEFAULT)
            never = f"{steps.count(math.inf)} of {plural(len(steps), 'draw')}"
            return f"{text}; in {never} it never fell to ½."
        return f"{text}; it fell to ½ after {half:,.0f} steps, in the median over draws."

    def _comparison(self, other: Profile) -> str:
        contrasts, groups = self.contrasts(other), dict[str, list[str]]()
        if not contrasts:
            return ""
        for label in sorted(contrasts, key=lambda label: -abs(contrasts[label].value)):
            each = contrasts[label]
            few = "as an indication only, " if each.verdict == "indication" else ""
            side = "worse" if each.value > 0 else "better"
            if each.verdict != "open":
                groups.setdefault(f"{few}{side} on", []).append(label)
        parts = [f"{words} {_listed(labels, contrasts)}" for words, labels in groups.items()]
        still = sum(each.verdict == "open" for each in contrasts.values())
        if still:
            parts.append(f"open on {still} of {len(contrasts)}")
        return f"Against {other.name}, by the difference of N₀: {'; '.join(parts)}."

    def draw(self, others: Iterable[Profile] | None = None) -> Any:
        """The figure of all axes, with the references behind, or with `others`."""
        from sme_registry.profiles.page import draw_axes

        return draw_axes(self, self.behind(others))

    def behind(self, others: Iterable[Profile] | None) -> list[Profile]:
        return self.comparable(Profile.references().values() if others is None else others)

    def table(self) -> Table:
        """A row for each axis: its levels, N₀ at each, and the robustness."""
        records = []
        for axis in AXES:
            regret = (self.level(name)._replace(low=math.nan) for name in axis.levels)
            records.append(
                {
                    "axis": axis.label,
                    "levels": " → ".join(axis.levels.values()),
                    "N₀": " → ".join(map(str, regret)),
                    "robustness": str(self.robustness(axis)),
                }
            )
        draws = f"{self.budget}, {len(self.rows)} of {self.planned} runs"
        caption = f"IQM over draws. Fewer than {ENOUGH_RUNS} draws are an indication only."
        return Table.of(f"[bold]{self.name}[/]  {draws}", records, caption=caption)

    @property
    def budget(self) -> str:
        """The steps of each training; a function may take fewer."""
        if not self.learns:
            return "no training"
        most = "at most " if self.algorithm.uses.startswith("train:") else ""
        return f"{most}{self.steps:,} steps"

    @property
    def planned(self) -> int:
        """How many runs it has if it is complete."""
        return len(self.classes) * self.seeds

    def __str__(self) -> str:
        from sme_registry.evaluation.report import as_text

        return as_text(self.table())

    def _repr_html_(self) -> str:
        return card(table_html(self.table()), *(f"<p>{text}</p>" for text in self.sentences()))


def _listed(labels: Sequence[str], estimates: Mapping[str, DrawEstimate]) -> str:
    """The first three with their estimates, and how many more."""
    texts = [f"{label} ({estimates[label]})" for label in labels[:_NAMED]]
    more = [f"{len(labels) - _NAMED} more"] if len(labels) > _NAMED else []
    return conjunction([*texts, *more])


def _kept(runs: Any) -> Array:
    """Robustness `[…, 1]` of N₀ `[n, …, 1 + levels]`, the base first."""
    performance = 1.0 - iqm(runs)
    kept = performance[..., 1:] / performance[..., :1]
    return np.asarray(kept.mean(axis=-1, keepdims=True))


def row_of(planned: PlannedCell, result: CellResult) -> ProfileRow:
    report, curve = result.report, result.curve
    assert report is not None  # the plan has no streams
    constant = 1.0 - report.references["constant"][0].similarity
    reached = (1.0 - np.array(curve.similarity)) <= _HALF * constant
    online = result.online_regret
    return ProfileRow(
        class_name=planned.class_name,
        run=planned.run,
        wd_regret=round(report.wd_regret, DIGITS),
        ood_regret=round(report.ood_regret, DIGITS),
        ood_decay=round(report.ood_decay, DIGITS),
        online_regret=None if online is None else round(online, DIGITS),
        evaluations=len(curve.steps),
        steps_to_half=curve.steps[int(reached.argmax())] if reached.any() else None,
    )
