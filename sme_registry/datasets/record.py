"""`DatasetRecord`: the metadata of a data set, stored under "sme" in Minari's metadata."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field

from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.datasets.scores import ReferenceScores
from sme_registry.errors import SpecError
from sme_registry.spec import Digest, Integer, StrictModel
from sme_registry.spec.document import refuse_other_digest
from sme_registry.spec.sme_spec import Seed

KEY = "sme"


class Seeds(StrictModel):
    """Seeds of the task and of the data (starts, α, ã and random actions)."""

    task: Seed
    data: Seed


class DatasetRecord(StrictModel):
    """Provenance, reference scores and digests of a data set.

    Attributes:
      schema_version: version of the record's format.
      recipe: all that the data set was generated from.
      recipe_digest, spec_digest, protocol_digest: of the recipe, its task and its protocol.
      task: what the task's file calls it.
      seeds: of the task and of the data.
      nu: ν if a single mixture acted; null for other or several behaviours.
      trajectories: E, the number of Minari episodes.
      scores: of reference policies on the data set.
      arrays_digest: see `Transitions.digest`.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: Literal[1] = 1
    recipe: DatasetRecipe
    recipe_digest: Digest
    spec_digest: Digest
    task: str = ""
    protocol_digest: Digest
    seeds: Seeds
    nu: float | None
    trajectories: Annotated[Integer, Field(ge=1)]
    scores: ReferenceScores
    arrays_digest: Digest
    versions: dict[str, str]

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data, and the digests of its documents; errors call it `source`."""
        version = data.get("schema_version") if isinstance(data, dict) else None
        if type(version) is int and version != 1:
            age = "an older" if version < 1 else "a newer"
            raise SpecError(
                f"{source}: {KEY}.schema_version={version}: must be 1. The data set was written by "
                f"{age} version of this package. Read it with that version or with Minari, or "
                "generate it again from its recipe."
            )
        record = super().from_dict(data, f"{source}: {KEY}")
        for field, document in (
            ("recipe_digest", record.recipe),
            ("spec_digest", record.recipe.spec),
            ("protocol_digest", record.recipe.protocol),
        ):
            refuse_other_digest(
                getattr(record, field),
                document,
                f"{source}: {KEY}.{field}",
                "Download the data set again, or generate it again.",
            )
        return record
