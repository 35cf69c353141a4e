"""The catalogue's pages: plain Markdown, whose sections the site shows as cards (`site.css`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from sme_registry.spec import EnvFile, SMESpec, StreamSpec, catalogue
from sme_registry.task import materialize

from . import pictures, results
from .entries import Entry, entries
from .measured import CHECKS, REFERENCES, measured


class Group(NamedTuple):
    """A page of the catalogue."""

    slug: str
    title: str


_GROUPS = {  # in the reference's order; an entry is in the last of which it has the tag
    "paper": Group("dimensions", "The default and its dimensions"),
    "axis-state_dim": Group("dimensions", "The default and its dimensions"),
    "axis-action_dim": Group("dimensions", "The default and its dimensions"),
    "axis-complexity": Group("complexity", "Layers of the optimal policy"),
    "axis-k": Group("rewards", "Interval, threshold and survival"),
    "axis-r_min": Group("rewards", "Interval, threshold and survival"),
    "axis-D": Group("rewards", "Interval, threshold and survival"),
    "plane": Group("plane", "The plane"),
    "axis-safety": Group("safety", "Limits, distractors and mixings"),
    "axis-compensated-safety": Group("safety", "Limits, distractors and mixings"),
    "axis-observation": Group("safety", "Limits, distractors and mixings"),
    "foresight": Group("foresight", "Foresight and noise"),
    "noise": Group("foresight", "Foresight and noise"),
    "hard": Group("hard", "Hard tasks"),
    "team": Group("teams", "Teams"),
    "continual": Group("streams", "Streams"),
}
_FIELDS = {"k": 1, "r_min": 0, "D": 0}  # shown where they differ from this
_JOINT, _FIXED = "\u2060", "\u00a0"  # narrow lines do not break at a dash, a × or a =
READING = """\
- **The pictures** show two action channels of π* over two state channels from −½ to 1½, with all
  others at ½: dark is 0, light is 1. The square is the cube in which agents train. Lines cross out
  where a limit forbids π*. [An explorer](../../guides/diagnosis.md#explore-any-state) shows
  any two channels.
- **`sme check`** certifies the drawn task; a warning means that it is correct but easy. Rewards
  are those of a step, at most 1.
- **N₀ and N̄** are normalised regret in the cube and outside it, the mean of five shells: 0 is the
  optimum, 1 the constant ½ in the same states
  ([how to read them](../../explanation/method.md#3-evaluation-inside-and-outside-the-cube)). The
  references are measured under `quick-v1`, with 2,000 states a region.
- **PPO, TD3 and SAC** were evaluated under `paper-v1`, with default hyperparameters (but PPO has
  `n_steps=2000` in streams and `gamma=0.9` under limits). The name links to the study; the steps of
  a run and the number of runs follow. N is the mean over runs (not the IQM of a board), with the
  lowest and the highest. The runs are on several draws of the same settings, sometimes with the
  id's own among them; all other numbers are those of the id. Where there are limits, none of the
  three knows of them, and the study says how often they are broken.
"""


def gallery() -> dict[Group, str]:
    """The page of each group: a card for each of its entries."""
    cards: dict[Group, list[str]] = {group: [] for group in _GROUPS.values()}
    numbers, files = measured(), pictures.names()
    levels, lives = results.levels(), results.lives()
    for name, file in entries().items():
        known, picture = numbers[name], files[name]
        if isinstance(file, EnvFile):
            table = _task_tables(known, levels.get(results.setting_of(file.spec), []))
            facts, caption = _facts(file.spec), _caption(file.spec)
        else:
            table = _stream_tables(known, lives.get(file.name, []))
            facts, caption = (
                _stream_facts(file.stream),
                "π\\*: a1 over s1, s2, at the start of the phases",
            )
        owner = picture.removesuffix(".png")
        if owner != name:
            caption += f"; as of {owner.rpartition('-v')[0]}"
        cards[group_of(file)].append(
            f"## {file.name}\n\n![{_alternative(file)}](../gallery/{picture})\n\n{caption}\n\n"
            f"{file.description}\n\n`{catalogue.NAMESPACE}/{name}`: {facts}\n\n"
            f"`{file.digest[:19]}`\n\n" + "\n\n".join(table) + "\n"
        )
    return {group: "\n".join([f"# {group.title}\n", *below]) for group, below in cards.items()}


def group_of(file: Entry) -> Group:
    """The page that has an entry's card."""
    return [group for tag, group in _GROUPS.items() if tag in file.tags][-1]


def anchor(name: str) -> str:
    """The address of a card within the page, by the entry's name without its version."""
    return name.lower()


def _alternative(file: Entry) -> str:
    kind = "optimal policy" if isinstance(file, EnvFile) else "optimal policies of the phases"
    return f"Map of the {kind} of {file.name}, inside and outside the training cube"


def _facts(spec: SMESpec) -> str:
    facts: dict[str, float] = {"S": spec.state_dim, "A": spec.action_dim, "L": spec.complexity}
    facts |= {name: v for name, plain in _FIELDS.items() if (v := getattr(spec, name)) != plain}
    if spec.safety is not None:
        facts["τ"] = spec.safety.tightness
    if spec.distractors:
        facts["m"] = spec.distractors
    if spec.team is not None:
        facts["agents"] = len(spec.team.agents)
    return ", ".join(f"{name}{_FIXED}={_FIXED}{value:g}" for name, value in facts.items())


def _stream_facts(stream: StreamSpec) -> str:
    steps = sorted({phase.steps for phase in stream.phases})
    visits = f"{stream.visits} visits of {' or '.join(f'{each:,}' for each in steps)} steps"
    return f"S = {stream.state_dim}, A = {stream.action_dim}, {visits}"


def _caption(spec: SMESpec) -> str:
    """What the two maps show, channels from 1."""
    task = materialize(spec)
    maps = [
        (f"{task.names[i]}: " if spec.team else "") + f"a{action + 1} over s{x + 1}, s{y + 1}"
        for i, (action, (x, y)) in enumerate(pictures.panels(task))
    ]
    if spec.team is None and len(maps) > 1:
        maps = ["a1 and a2 over s1, s2"]
    return "π\\*: " + "; ".join(maps)


def _task_tables(known: dict[str, Any], levels: list[results.Level]) -> list[str]:
    certificate = [(CHECKS[name], f"{value:.3f}") for name, value in known["checks"].items()]
    rows = [
        (REFERENCES[name], *map(_value, values)) for name, values in known["references"].items()
    ]
    for level in levels:
        effort = _FIXED.join((f"{level.steps:,}", "×", f"{len(level.cube)}"))
        study = f"[{level.algorithm}]({_page(level.page)}), {effort}"
        rows.append((study, _spread(level.cube), _spread(level.shells)))
    return [
        _table(("`sme check`", known["outcome"]), certificate),
        _table(("", "N₀", "N̄"), rows),
    ]


def _stream_tables(known: dict[str, Any], lives: list[results.Life]) -> list[str]:
    phases = known["phases"]
    outcomes = list(dict.fromkeys(phase["outcome"] for phase in phases))
    certificate = [
        (label, _ends([phase["checks"][name] for phase in phases]))
        for name, label in CHECKS.items()
        if name in phases[0]["checks"]
    ]
    tables = [_table(("`sme check`, over phases", ", ".join(outcomes)), certificate)]
    if lives:
        counts = ", ".join(str(life.lives) for life in lives)
        link = f"[{counts} lives]({_page(results.STREAM_PAGE)}), IQM"
        rows = [
            (label, *(_value(life.metrics[name]) for life in lives))
            for name, label in results.METRICS.items()
        ]
        tables.append(_table((link, *(life.algorithm for life in lives)), rows))
    return tables


def _page(name: str) -> str:
    return f"../../results/{name}"


def _spread(values: list[float]) -> str:
    mean = sum(values) / len(values)
    return f"{mean:.2f} ({min(values):.2f}{_JOINT}–{_JOINT}{max(values):.2f})"


def _ends(values: list[float]) -> str:
    low, high = f"{min(values):.3f}", f"{max(values):.3f}"
    return low if low == high else f"{low} to {high}"


def _value(value: float) -> str:
    return f"{value:.2f}"


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
