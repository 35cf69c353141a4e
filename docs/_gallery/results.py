"""How PPO, TD3 and SAC did on the tasks of the catalogue, from the tables under docs/results.

Studies train on several seeds of a setting, which is every field of a task but its seed. So a
study counts for a task if it has the task's setting.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

from sme_registry.spec import Setting, SMESpec, StudyFile, SuiteClass, SuiteFile, catalogue
from sme_registry.statistics import iqm

RESULTS = Path(__file__).parents[1] / "results"
ALGORITHMS = ("PPO", "TD3", "SAC")


class Study(NamedTuple):
    """A table with one row a run.

    Attributes:
      table: its file, in the folder of results.
      page: the page that describes it.
      tasks: the suite that its tasks are of, or the file of its plan.
      regions: the columns of normalised regret: the cube's, then those of the shells.
    """

    table: str
    page: str
    tasks: str
    regions: tuple[str, ...]


class Level(NamedTuple):
    """The normalised regret of an algorithm in `[runs]` runs: N₀, and N̄ over the shells."""

    algorithm: str
    steps: int
    cube: list[float]
    shells: list[float]
    page: str


class Life(NamedTuple):
    """The IQMs, over an algorithm's lives in a stream, of metrics in the cube."""

    algorithm: str
    lives: int
    metrics: dict[str, float]


_BY_REGION = tuple(f"normalised_regret_{m}" for m in range(6))
_TOGETHER = ("wd_regret", "ood_regret")
_LIMITS = "limits-and-distractors"
# A setting has the rows of the first page that knows it.
STUDIES = (
    Study("ablations-in-jax/runs-20000.csv", "decay.md", "paper-ablations", _BY_REGION),
    Study("ablations-in-jax/runs.csv", "ablations.md", "paper-ablations", _BY_REGION),
    Study("baselines.csv", "agents.md#on-smoke-v1-by-the-rule-of-a-board", "smoke", _TOGETHER),
    *(
        Study(
            f"{_LIMITS}/{name}.csv",
            "limits_and_distractors.md",
            f"{_LIMITS}/{name}-plan.json",
            _TOGETHER,
        )
        for name in ("representation", "safety")
    ),
)
LIVES, STREAM_PAGE = "continual/lives.csv", "continual.md"
METRICS = {  # of lives, by the columns of their table
    "visited_regret": "N at the end of visits",
    "forgetting": "forgetting",
    "plasticity_ratio": "plasticity ratio",
}


def setting_of(spec: SMESpec) -> str:
    """The digest of a task's setting."""
    fields = spec.to_dict()
    del fields["seed"]
    return Setting.from_dict(fields).digest


def levels() -> dict[str, list[Level]]:
    """What is known of each setting, by its digest."""
    found: dict[str, list[Level]] = {}
    for study in STUDIES:
        for setting, rows in _rows(study).items():
            known = found.setdefault(setting, [])
            if all(level.page == study.page for level in known):
                known += rows
    return found


def lives() -> dict[str, list[Life]]:
    """What is known of each stream of the catalogue, by its name without the version."""
    rows: dict[tuple[str, str], list[dict[str, str]]] = defaultdict(list)
    for row in _table(LIVES):
        if row["region"] == "WD":
            rows[row["class_name"], row["algorithm"]].append(row)
    streams: dict[str, list[Life]] = defaultdict(list)
    for (stream, algorithm), of_method in rows.items():
        values = {name: float(iqm([float(row[name]) for row in of_method])) for name in METRICS}
        streams[stream].append(Life(algorithm, len(of_method), values))
    return streams


def _rows(study: Study) -> dict[str, list[Level]]:
    """The levels of a study's table, by setting; the algorithms in order."""
    classes: tuple[SuiteClass, ...]
    if study.tasks.endswith(".json"):
        classes = StudyFile.read(RESULTS / study.tasks).plan.classes
    else:
        classes = catalogue.find(SuiteFile, study.tasks).suite.classes
    settings = {spec.digest: each.setting.digest for each in classes for spec in each.instances}
    found: dict[str, dict[tuple[str, int], Level]] = defaultdict(dict)
    for row in _table(study.table):
        algorithm = row.get("algorithm") or row["method"]
        if algorithm not in ALGORITHMS:
            continue
        key = algorithm, int(row["steps"])
        of_setting = found[settings[row["spec_digest"]]]
        level = of_setting.setdefault(key, Level(*key, [], [], study.page))
        cube, *shells = (float(row[column]) for column in study.regions)
        level.cube.append(cube)
        level.shells.append(sum(shells) / len(shells))
    return {
        setting: sorted(of.values(), key=lambda level: ALGORITHMS.index(level.algorithm))
        for setting, of in found.items()
    }


def _table(name: str) -> list[dict[str, str]]:
    with (RESULTS / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
