"""`make_dataset`: generate a data set of a chosen quality and write it to disk."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import Any

from sme_registry.datasets.collect import ReportProgress, collect
from sme_registry.datasets.minari_format import require_minari
from sme_registry.datasets.recipe import DatasetRecipe, parse_behaviour
from sme_registry.datasets.record import DatasetRecord, Seeds
from sme_registry.datasets.scores import reference_scores
from sme_registry.datasets.storage import (
    NAMESPACE,
    Dataset,
    check_id,
    check_target,
    datasets_folder,
    write_dataset,
)
from sme_registry.errors import OptionError
from sme_registry.evaluation import resolve_protocol
from sme_registry.io import choice, versions
from sme_registry.spec import ACTION_RANGES, ProtocolLike, SMESpec, SpecLike, catalogue
from sme_registry.task import load, materialize

_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "h5py", "minari")


def make_dataset(
    spec_or_id: SpecLike,
    nu: float | None = None,
    *,
    mix: Sequence[tuple[Any, float]] | None = None,
    transitions: int = 50_000,
    seed: int | str = 0,
    coverage: float | None = None,
    protocol: ProtocolLike = "paper-v1",
    action_range: str | None = None,
    name: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: ReportProgress | None = None,
) -> Dataset:
    """Generate a data set of a chosen quality and write it in Minari's HDF5 format.

    It is written completely or not at all. The same arguments give the same bits of every array and
    the same bytes of the file.

    Args:
      spec_or_id: the task: a spec, its fields, an id, a digest or a path.
      nu: ν in [0, 1] of the mixture that acts: 0 is the optimum, 1 the worst. The default is 0.5
        unless `mix` is given.
      mix: several behaviour policies instead of `nu`: pairs of a policy (ν as a number; "random"; a
        callable, a Stable-Baselines3 model, or the path of its .zip or of an .onnx) and its share
        of the transitions. The shares must add up to 1.
      transitions: N, the exact number; the last episode of each behaviour is truncated.
      seed: of the starts, each α, ã and random actions; independent of the task's. An integer in
        [0, 2⁵³), or hexadecimal text such as '0x9f86'.
      coverage: ε in (−1, 0]: keeps only transitions from {s : ‖s − ½‖_∞ ≤ (1 + ε)/2}, so that
        E(s) − ε of a state is its distance from the data.
      protocol: for the evaluation of policies that learn from the data set; stored in its record.
      action_range: of the policies' actions in `mix`; None takes their own.
      name: Minari's id, `[namespace/]name-v<number>`; None generates a descriptive one. A name that
        is taken is a NameTakenError, which compares the two recipes.
      folder: the root of all data sets; None for Minari's folder.
      force: replace an existing data set of this package.
      progress: called after each step with the transitions collected and their total.

    Examples:
      >>> from sme_registry.datasets import make_dataset
      >>> data = make_dataset("Default", 0.3, transitions=200, folder="mine", protocol="quick-v1")
      >>> len(data.transitions())
      200
    """
    require_minari()
    if nu is not None and mix is not None:
        raise OptionError("nu, mix: give only one of them. `mix` accepts ν as a policy.")
    if action_range is not None:
        choice("action_range", action_range, ACTION_RANGES)
    pairs = [(0.5 if nu is None else nu, 1.0)] if mix is None else list(mix)
    behaviours = tuple(parse_behaviour(policy, weight, action_range) for policy, weight in pairs)
    recipe = DatasetRecipe.from_dict(
        {
            "spec": load(spec_or_id, SMESpec),
            "behaviours": behaviours,
            "transitions": transitions,
            "seed": seed,
            "coverage": coverage,
            "protocol": resolve_protocol(protocol),
        },
        "data set",
    )
    policies = dict(enumerate(policy for policy, _ in pairs))
    dataset_id = check_id(default_id(recipe) if name is None else name)
    root = datasets_folder(folder)
    check_target(root / dataset_id, root, recipe, force)  # before the work, too

    task = materialize(recipe.spec)
    arrays = collect(recipe, task, policies, progress=progress)
    record = DatasetRecord(
        recipe=recipe,
        recipe_digest=recipe.digest,
        spec_digest=recipe.spec.digest,
        task=recipe.spec.name,
        protocol_digest=recipe.protocol.digest,
        seeds=Seeds(task=recipe.spec.seed, data=recipe.seed),
        nu=behaviours[0].nu if len(behaviours) == 1 else None,
        trajectories=len(arrays.ends),
        scores=reference_scores(recipe, task, arrays, policies),
        arrays_digest=arrays.digest,
        versions=versions(_PACKAGES),
    )
    return write_dataset(dataset_id, record, arrays, root, force=force)


def default_id(recipe: DatasetRecipe) -> str:
    """`sme/Default-v1-nu50-side80-seed7-v0`: task, behaviour, the sub-cube's side, data seed."""
    title = catalogue.unique_name(recipe.spec)
    behaviour = recipe.behaviours[0]
    if len(recipe.behaviours) > 1:
        acting = f"mix-{recipe.digest.removeprefix('sha256:')[:8]}"
    elif behaviour.nu is not None:
        acting = f"nu{_hundredths(behaviour.nu)}"
    elif behaviour.kind == "random":
        acting = "random"
    else:
        acting = "policy-" + re.sub("[^A-Za-z0-9]", "_", behaviour.label)
    side = "" if not recipe.coverage else f"-side{_hundredths(1.0 + recipe.coverage)}"
    return f"{NAMESPACE}/{title}-{acting}{side}-seed{recipe.seed}-v0"


def _hundredths(value: float) -> str:
    """0.5 as `50`, 0.125 as `12_5`."""
    return f"{100 * value:.10g}".replace(".", "_").replace("-", "m").replace("+", "")
