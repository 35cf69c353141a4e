"""`profile`: run the study of a profile, or read one that covers it."""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io import check_writable, choice, integer_in, require_packages
from sme_registry.io.system import module_file
from sme_registry.profiles.document import AXES, DEFAULT, Profile, ProfileFailure, plan_file, row_of
from sme_registry.profiles.page import write_page
from sme_registry.spec import StudyAlgorithm, StudyFile, StudyPlan
from sme_registry.spec.study import Cell
from sme_registry.studies.budget import scaled
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.runner import run_study
from sme_registry.training import algorithms, functions

QUICK_SEEDS = 2


def profile(
    train: Callable[..., Any] | str,
    *,
    steps: int | None = None,
    seeds: int | None = None,
    name: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    agents: str | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    quick: bool = False,
    jobs: int | None = None,
    retry_failed: bool = False,
    progress: bool = True,
) -> Profile:
    """Train an algorithm on the default and on harder levels of nine axes, and say what breaks it.

    It is a study: the same call continues an interrupted one, and results are reused. Its page, the
    figure as PDF and the facts as JSON are in the folder.

    Args:
      train: a function `train(env, steps, seed) -> policy`; or the name of an algorithm, as in
        `sme_registry.train`, such as "PPO" or "train:module:function". A function of a notebook or
        of a script runs in this process, and its own source alone says whether results are reused.
      steps: of each training; by default 20,000, those of the reference profiles.
      seeds: draws of each level; by default 5, quick 2.
      name: of the profile; by default the algorithm's.
      folder: by default runs/profile-NAME.
      agents: "jax" for an algorithm in JAX.
      quick: only the default and the hardest level of each axis.
      jobs: runs at once; by default one for each core.

    Examples:
      >>> import sme_registry
      >>> def train(env, budget):  # has no seed
      ...     return lambda observations: 0.5 + 0.0 * observations[:, :4]
      >>> sme_registry.profile(train)
      Traceback (most recent call last):
      sme_registry.errors.OptionError: ...: cannot be called with an environment, steps, a seed ...
    """
    require_packages("profiles", {"matplotlib": "Matplotlib", "pandas": "pandas"}, "studies")
    steps = None if steps is None else integer_in("steps", steps, 1)
    algorithm = _algorithm(train, name, agents, hyperparameters or {})
    folder = default_folder(algorithm.name) if folder is None else Path(folder)
    file = study_of(algorithm, steps=steps, seeds=QUICK_SEEDS if quick and not seeds else seeds)
    _check_folder(folder, file, algorithm)
    check_writable(folder / "profile.json")
    in_memory = functions.is_in_memory(algorithm.uses)
    if in_memory and jobs not in (None, 1):
        raise OptionError(
            f"jobs={jobs}: must be 1 for a function of a notebook or a script, which runs in this "
            "process. Put it into a module of its own, or leave it out."
        )
    classes = quick_classes() if quick else tuple(member.name for member in file.plan.classes)
    run_study(
        file,
        folder,
        executor="in-process" if in_memory else None,
        jobs=jobs,
        only=[f"class={name}" for name in classes],
        retry_failed=retry_failed,
        progress=progress,
    )
    made = profile_of(folder, classes=classes)
    write_page(made, folder)
    return made


def default_folder(name: str) -> Path:
    return Path("runs") / f"profile-{slug(name)}"


def quick_classes() -> tuple[str, ...]:
    """The bases and the hardest level of each axis."""
    bases = dict.fromkeys(axis.base for axis in AXES)
    return (*bases, *(axis.harder[-1] for axis in AXES))


def slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")


def study_of(
    algorithm: StudyAlgorithm, *, steps: int | None = None, seeds: int | None = None
) -> StudyFile:
    """The study of a profile: the plan of all profiles with this algorithm."""
    fields = plan_file().plan.to_dict() | {"algorithms": [algorithm.to_dict()]}
    for member in fields["classes"]:  # each run has a draw of its own
        drawn = range(1, 1 + max(len(member["seeds"]), seeds or 0))
        member["seeds"] = list(drawn)
    plan = StudyPlan.from_dict(fields, "profile")
    name = f"profile-{slug(algorithm.name)}"[:64]
    file = StudyFile(name=name, digest=plan.digest, plan=plan)
    return scaled(file, steps=steps, seeds=seeds)


def _algorithm(
    train: Callable[..., Any] | str,
    name: str | None,
    agents: str | None,
    hyperparameters: Mapping[str, Any],
) -> StudyAlgorithm:
    uses = train if isinstance(train, str) else _uses_of(train)
    uses = algorithms.full_name(uses, agents)
    kind, inner = algorithms.parse_uses(uses)
    if kind == "train":
        function, _ = functions.load_function(inner)
        functions.check_signature(inner, function, hyperparameters)
        module, _, attribute = inner.partition(":")
        default = module if attribute == "train" and module != "__main__" else attribute
    else:
        default = algorithms.folder_name(uses)
    fields = {
        "name": re.sub(r"[^A-Za-z0-9 ._+()-]", "-", name or default)[:64],
        "uses": uses,
        "hyperparameters": dict(hyperparameters),
        "steps": 0 if kind == "reference" else None,
    }
    algorithms.check_hyperparameters(uses, hyperparameters)
    return StudyAlgorithm.from_dict(fields, "algorithm")


def _uses_of(train: Callable[..., Any]) -> str:
    """The `uses` of a function: by the module that has it, else in this process."""
    if not inspect.isfunction(train):
        raise OptionError(
            f"train={train!r:.60}: must be a function train(env, steps, seed) that returns a "
            "policy, or the name of an algorithm, such as 'PPO'."
        )
    module, name = train.__module__, train.__qualname__
    file = getattr(sys.modules.get(module), "__file__", None)
    if module != "__main__" and name.isidentifier() and file and module_file(module) == file:
        return f"train:{module}:{name}"
    return functions.keep_in_memory(train)


def _check_folder(folder: Path, plan: StudyFile, algorithm: StudyAlgorithm) -> None:
    """Refuse the folder of another study: its plan would be replaced."""
    earlier = Ledger(folder).plan_file()
    if earlier is None:
        return
    found = [(each.uses, each.hyperparameters) for each in earlier.plan.algorithms]
    levels, known = ({m.name: m.setting for m in file.plan.classes} for file in (plan, earlier))
    if found != [(algorithm.uses, algorithm.hyperparameters)] or levels != known:
        listed = ", ".join(each.name for each in earlier.plan.algorithms)
        raise OptionError(
            f"folder={str(folder)!r}: holds the study {earlier.versioned_name} of {listed}, not a "
            f"profile of {algorithm.name} with these hyperparameters. Give another folder."
        )


def profile_of(
    folder: str | os.PathLike[str],
    algorithm: str | None = None,
    *,
    classes: Sequence[str] | None = None,
) -> Profile:
    """The profile of an algorithm of a study that covers it, at least the default.

    A run counts if it is on the task of a level, with its seed, and its protocol and steps are
    those of the other runs that count; its evaluations may be more or fewer.
    """
    profile = part_of_profile(folder, algorithm, classes=classes)
    if not profile.values(DEFAULT):
        errors = [f"The first failure: {failure.error}" for failure in profile.failures]
        raise OptionError(
            f"folder={str(folder)!r}: has no finished run on the default, from which robustness is "
            f"computed, with the profile's draws, {profile.steps:,} steps and its protocol. "
            f"{errors[0] if errors else 'Run that class of the plan profile-v1, too.'}"
        )
    return profile


def part_of_profile(
    folder: str | os.PathLike[str],
    algorithm: str | None = None,
    *,
    classes: Sequence[str] | None = None,
) -> Profile:
    """The same of whatever runs the folder has."""
    ledger, released = Ledger(folder), plan_file()
    plan = ledger.study_file().plan
    chosen = _chosen(plan, algorithm)
    file = study_of(chosen, steps=chosen.steps or plan.steps or None, seeds=plan.seeds)
    names = tuple(m.name for m in file.plan.classes) if classes is None else tuple(classes)
    of_study = [each.cell for each in plan.cells if each.algorithm == chosen.name]
    keys = {_task(cell): cell.digest for cell in of_study if cell.stream is None}
    wanted = [each for each in file.plan.cells if each.class_name in names]
    places = {key: each for each in wanted if (key := keys.get(_task(each.cell)))}
    results = ledger.results(places)
    failures = ledger.failures(key for key in places if key not in results)
    return Profile(
        algorithm=chosen,
        plan=released.versioned_name,
        plan_digest=released.digest,
        protocol_digest=released.plan.protocol.digest,
        steps=file.plan.steps,
        seeds=file.plan.seeds,
        classes=names,
        rows=tuple(row_of(places[key], result) for key, result in results.items()),
        failures=tuple(
            ProfileFailure(
                class_name=places[key].class_name, run=places[key].run, error=failure.error[:500]
            )
            for key, failure in failures.items()
        ),
        versions={k: v for result in results.values() for k, v in result.versions.items()},
    )


def _task(cell: Cell) -> tuple[str, int, int, str]:
    return cell.spec.digest, cell.seed, cell.steps, cell.protocol.digest


def _chosen(plan: StudyPlan, name: str | None) -> StudyAlgorithm:
    known = {algorithm.name: algorithm for algorithm in plan.algorithms}
    if name is None and len(known) == 1:
        return plan.algorithms[0]
    return known[choice("algorithm", name, known, error=UnknownNameError)]
