"""`write_page`: the page of a profile, its figure as PDF, and the facts as JSON.

FOLDER/profile.html    one file that loads nothing: sentences, two figures, tables, origin
FOLDER/profile.pdf     the figure of all axes
FOLDER/profile.json    the `Profile`
"""

from __future__ import annotations

import base64
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from sme_registry.io import write_atomically
from sme_registry.io.markup import environment, fixed
from sme_registry.plots.style import encoded
from sme_registry.profiles.document import Profile
from sme_registry.profiles.figures import draw_axes, draw_robustness
from sme_registry.profiles.levels import AXES
from sme_registry.studies import report


class _Table(NamedTuple):
    title: str
    note: str
    rows: list[dict[str, str]]


def write_page(
    profile: Profile,
    folder: str | os.PathLike[str],
    references: Iterable[Profile] | None = None,
) -> list[Path]:
    """Write the page, the PDF and the JSON, and return their paths, the page first.

    `references` are drawn behind, as far as they are comparable; by default the package's.
    """
    known = Profile.references().values() if references is None else references
    others = profile.comparable(known)
    drawn = {"axes": draw_axes(profile, others), "robustness": draw_robustness(profile, others)}
    folder = Path(folder)
    pdf = encoded(drawn["axes"], ["pdf"])["pdf"]
    svgs = {name: encoded(figure, ["svg"])["svg"] for name, figure in drawn.items()}
    return [
        write_atomically(folder / "profile.html", page(profile, others, svgs)),
        write_atomically(folder / "profile.pdf", pdf),
        profile.write(folder / "profile.json"),
    ]


def page(profile: Profile, others: Sequence[Profile], figures: Mapping[str, bytes]) -> str:
    templates = environment(Path(__file__).parent / "templates", autoescape=True)
    style = (Path(report.__file__).parent / "page.css").read_text(encoding="utf-8")
    return templates.get_template("profile.html.jinja").render(
        profile=profile,
        sentences=profile.sentences(others),
        style=Markup(style),
        figures={name: base64.b64encode(svg).decode() for name, svg in figures.items()},
        tables=[_robustness(profile, others), *_differences(profile, others), _levels(profile)],
        origin=[*_origin(profile, others)],
    )


def _robustness(profile: Profile, others: Sequence[Profile]) -> _Table:
    compared = [profile, *(each for each in others if each.name != "constant")]
    rows = [
        {"axis": axis.label} | {each.name: str(each.robustness(axis)) for each in compared}
        for axis in AXES
    ]
    note = "What is kept of the performance at the harder levels, with 95 % intervals over draws."
    return _Table("Robustness", note, rows)


def _differences(profile: Profile, others: Sequence[Profile]) -> Iterator[_Table]:
    compared = {other.name: profile.contrasts(other) for other in others if other.learns}
    labels = dict.fromkeys(label for contrasts in compared.values() for label in contrasts)
    if not labels:
        return
    rows = []
    for label in labels:
        row = {"axis": label}
        for name, contrasts in compared.items():
            each = contrasts.get(label)
            row[f"vs. {name}"] = "–" if each is None else f"{each} {each.verdict}"
        rows.append(row)
    note = (
        f"N₀ of {profile.name} minus that of the other, over the harder levels of each axis: below "
        "0 it is better. In pairs, on the same draw with the same seed; IQM over pairs, mean over "
        "levels, with 95 % intervals. Open: the interval includes 0."
    )
    yield _Table(f"Difference of {profile.name} from the references", note, rows)


def _levels(profile: Profile) -> _Table:
    failed = dict.fromkeys(profile.classes, 0)
    for failure in profile.failures:
        failed[failure.class_name] += 1
    rows = []
    for name in dict.fromkeys((*profile.classes, *_every_level())):
        done, count = profile.level(name), failed.get(name, 0)
        row = {"level": name, "N₀": str(done)}
        row["N̄ outside"] = str(profile.level(name, "ood_regret"))
        row["decay"] = _percent(profile.level(name, "ood_decay").value)
        row["online regret"] = _number(profile.level(name, "online_regret").value)
        row["steps to N₀ ≤ ½"] = _steps(profile, name)
        row["draws"] = f"{done.draws}" + (f", {count} failed" if count else "")
        rows.append(row)
    note = (
        "N₀ within the training cube, N̄ its mean over the shells around it, decay the share of "
        "similarity that is lost there, online regret the mean of 1 − reward over all steps of "
        "training. IQM over draws, of steps the median; “never” within these steps."
    )
    return _Table("Every level", note, rows)


def _every_level() -> list[str]:
    return [name for axis in AXES for name in axis.levels]


def _steps(profile: Profile, name: str) -> str:
    steps = profile.steps_to_half(name)
    return "–" if steps is None else "never" if math.isinf(steps) else f"{steps:,.0f}"


def _number(value: float) -> str:
    return "–" if math.isnan(value) else fixed(value, 3)


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.1%}"


def _origin(profile: Profile, others: Sequence[Profile]) -> Iterator[tuple[str, str, str]]:
    """A name, a digest or other code, and a text."""
    algorithm = profile.algorithm
    settings = ", ".join(f"{k} = {v}" for k, v in sorted(algorithm.hyperparameters.items()))
    yield "algorithm", algorithm.uses, settings or "default hyperparameters"
    if algorithm.source:
        yield "source", algorithm.source, "of its module"
    done, failed = len(profile.rows), len(profile.failures)
    absent = profile.planned - done - failed
    counts = [f"{done} of {profile.planned} finished"]
    counts += [f"{failed} failed"] * bool(failed) + [f"{absent} not run"] * bool(absent)
    yield "runs", "", f"{', '.join(counts)}; {profile.steps:,} steps each"
    yield "draws", "", f"{profile.seeds} of each level, the seed of training is their number"
    yield "plan", profile.plan_digest, profile.plan
    yield "protocol", profile.protocol_digest, "of N₀ and N̄"
    yield "versions", "", _versions(profile)
    for other in others:
        uses = other.algorithm.uses
        yield f"reference {other.name}", uses, f"{len(other.rows)} runs; {_versions(other)}"


def _versions(profile: Profile) -> str:
    return ", ".join(f"{name} {version}" for name, version in sorted(profile.versions.items()))
