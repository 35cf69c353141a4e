"""`make_dataset`: a task, who acts in it, and a seed to a data set on disk."""

from __future__ import annotations

import contextlib
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from typing import Any

from sme_registry.datasets import minari_file
from sme_registry.datasets.collect import Progress, collect
from sme_registry.datasets.minari_file import Dataset, DatasetRecord, Seeds
from sme_registry.datasets.recipe import Behaviour, DatasetRecipe, behaviour_of
from sme_registry.datasets.scores import reference_scores
from sme_registry.errors import OptionError
from sme_registry.evaluation import resolve_protocol
from sme_registry.spec import EvaluationProtocol, SMESpec, catalogue
from sme_registry.task import load_spec, materialize

_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "h5py", "minari")


def make_dataset(
    spec_or_id: SMESpec | dict[str, Any] | str | os.PathLike[str],
    nu: float | None = None,
    *,
    mix: Sequence[tuple[Any, float]] | None = None,
    transitions: int = 50_000,
    seed: int = 0,
    coverage: float | None = None,
    protocol: EvaluationProtocol | dict[str, Any] | str | os.PathLike[str] = "paper-v1",
    action_range: str | None = None,
    name: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """Make a data set of a chosen quality and write it as Minari's HDF5, whole or not at all.

    The same arguments give the same bits of every array, and the same bytes of the file.

    Args:
      spec_or_id: the task: a spec, its fields, an id, a digest or a path.
      nu: ν in [0, 1] of the mixture that acts: 0 is the optimum, 1 the worst. 0.5 where neither
        this nor `mix` is given.
      mix: several behaviour policies in place of `nu`: pairs of who acts (ν as a number; "random";
        or a policy: a callable, a Stable-Baselines3 model, the path of its .zip or of an .onnx)
        and its share of the transitions; the shares add up to 1.
      transitions: N, exactly so many; the last episode of each behaviour is cut, a truncation.
      seed: of the starts, each α, ã and random actions, in [0, 2⁵³); not the task's.
      coverage: ε in (−1, 0]: keep only transitions acted in {s : ‖s − ½‖_∞ ≤ (1 + ε)/2}, so that
        E(s) − ε of a state is its distance from the data.
      protocol: where policies that learn from the set are to be judged; goes into its record.
      action_range: of the policies' actions in `mix`; None for their own.
      name: Minari's id of the set, `[namespace/]name-v<number>`; None for one that says what it is.
      folder: where sets lie; None for Minari's folder.
      force: replace a set that is there.
      progress: called after each step with the transitions made and those wanted.

    Returns:
      The set.

    Raises:
      UnknownNameError, SpecError: no such task or protocol, or a field outside its range.
      OptionError: a name that Minari refuses, too small a sub-cube, a full disk.
      NameTakenError: there is a set of this name; says whether it is the same one.
      PolicyError: a policy cannot be used.
      ResourceLimitError: the set would not fit in memory.
      MissingDependencyError: Minari with its HDF5 extra is not installed.
    """
    minari_file.require_minari()
    if nu is not None and mix is not None:
        raise OptionError("nu, mix: give one of the two; ν can be one of the mix.")
    if action_range not in (None, "unit", "symmetric"):
        raise OptionError(f"action_range={action_range!r}: must be 'unit' or 'symmetric'.")
    acting = [(0.5 if nu is None else nu, 1.0)] if mix is None else list(mix)
    behaviours = tuple(behaviour_of(what, weight, action_range) for what, weight in acting)
    recipe = DatasetRecipe.from_dict(
        {
            "spec": load_spec(spec_or_id),
            "behaviours": behaviours,
            "transitions": transitions,
            "seed": seed,
            "coverage": coverage,
            "protocol": resolve_protocol(protocol),
        },
        "data set",
    )
    policies = {
        index: what for index, (what, _) in enumerate(acting) if behaviours[index].kind == "policy"
    }
    dataset_id = minari_file.checked_id(default_id(recipe) if name is None else name)
    place = minari_file.datasets_folder(folder)
    # Known now, rather than after the work.
    minari_file.refuse_existing(place / dataset_id, place, recipe, force)

    task = materialize(recipe.spec)
    made = collect(recipe, task, policies, progress=progress)
    only = recipe.behaviours[0] if len(recipe.behaviours) == 1 else None
    record = DatasetRecord(
        recipe=recipe,
        recipe_digest=recipe.digest,
        spec_digest=recipe.spec.digest,
        protocol_digest=recipe.protocol.digest,
        seeds=Seeds(task=recipe.spec.seed, data=recipe.seed),
        nu=None if only is None else only.nu,
        trajectories=len(made.ends),
        scores=reference_scores(recipe, task, made, policies),
        arrays_digest=made.digest,
        versions=_versions(),
    )
    return minari_file.write(dataset_id, record, made, place, force=force)


def default_id(recipe: DatasetRecipe) -> str:
    """`sme/Default-v1-nu50-seed7-v0`: the task, who acts, the sub-cube's side, the data's seed."""
    title = catalogue.title(recipe.spec).rpartition("/")[2]
    if len(recipe.behaviours) > 1:
        acting = f"mix-{recipe.digest.removeprefix('sha256:')[:8]}"
    else:
        acting = _part(recipe.behaviours[0])
    side = "" if not recipe.coverage else f"-side{_hundredths(1.0 + recipe.coverage)}"
    return f"{minari_file.NAMESPACE}/{title}-{acting}{side}-seed{recipe.seed}-v0"


def _part(behaviour: Behaviour) -> str:
    if behaviour.nu is not None:
        return f"nu{_hundredths(behaviour.nu)}"
    if behaviour.kind == "random":
        return "random"
    return "policy-" + "".join(c if c.isascii() and c.isalnum() else "_" for c in behaviour.label)


def _hundredths(value: float) -> str:
    """0.5 as `50`, 0.125 as `12_5`."""
    return f"{100 * value:.10g}".replace(".", "_").replace("-", "m").replace("+", "")


def _versions() -> dict[str, str]:
    """Of what the numbers depend on, where installed."""
    from sme_registry import __version__

    versions = {"sme_registry": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions
