"""`Suite`: a list of classes; a class is one setting with its instances (seeds).

So a method is evaluated on a kind of task, not on one draw of it.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from sme_registry.spec.document import (
    Document,
    Name,
    SchemaVersion,
    refuse_repeated_names,
)
from sme_registry.spec.sme_spec import Seed, Setting, SMESpec
from sme_registry.spec.validation_errors import short_repr


class SuiteClass(Document):
    """One kind of task: a setting of the axes and the seeds of its instances."""

    name: Name
    setting: Setting
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1, max_length=10_000, strict=False)]

    @model_validator(mode="after")
    def _seeds_differ(self) -> Self:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(
                f"seeds={short_repr(list(self.seeds))}: must be distinct. Remove repeats."
            )
        return self

    @property
    def instances(self) -> tuple[SMESpec, ...]:
        """The specs of this class, in the order of its seeds."""
        fields = self.setting.to_dict()
        return tuple(SMESpec.from_dict({**fields, "seed": seed}) for seed in self.seeds)


class Suite(Document):
    """Classes of tasks under different names."""

    schema_version: SchemaVersion = 1
    classes: Annotated[tuple[SuiteClass, ...], Field(min_length=1, max_length=1000, strict=False)]

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        refuse_repeated_names("classes", self.classes)
        return self

    @property
    def instances(self) -> tuple[SMESpec, ...]:
        """Every spec of the suite, class by class."""
        return tuple(spec for member in self.classes for spec in member.instances)
