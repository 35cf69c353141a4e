"""`EvaluationReport`: what an evaluation found, as a document to write, share and read again.

Of a policy's clipped actions a and the optimal ones a*, over the states of a region:

    r̃ = 1 − mean |a − a*|                        similarity, in [0, 1]
    normalised regret = mean |a − a*| / mean |½ − a*|    0 for the optimum, 1 for the constant ½
    decay at m = (r̃_WD − r̃_m) / r̃_WD             in points: 100 (r̃_WD − r̃_m)
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from sme_registry.errors import DigestMismatchError
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec import EvaluationProtocol, SMESpec, catalogue
from sme_registry.spec.document import Integer, Real, StrictModel

if TYPE_CHECKING:
    from rich.table import Table

NOT_COMPARABLE = (
    "Levels ε are not comparable between different state_dim: the more channels, the nearer a "
    "shell's states lie to its outer face."
)

LABELS = {
    "optimal": "optimal",
    "linear_least_squares": "linear (LSQ)",
    "best_constant": "best constant",
    "constant_half": "constant ½",
    "uniform_random": "random",
}


class ChannelReport(StrictModel):
    """One action channel in one region.

    Attributes:
      mae: mean |a − a*| of the channel, in [0, 1].
      normalised_regret: the same over mean |½ − a*| of the channel.
    """

    mae: Real
    normalised_regret: Real


class RegionReport(StrictModel):
    """One policy in one region.

    Attributes:
      name: `WD`, `OOD 1`, …
      epsilon_low: ε of the inner face, which belongs to the region inside; 0 for WD.
      epsilon_high: ε of the outer face, which belongs to this region; 0 for WD.
      states: how many states.
      similarity: mean r̃.
      similarity_sd: standard deviation of r̃ over states (not over seeds).
      mae: mean |a − a*| = 1 − r̃.
      normalised_regret: 0 for the optimum, 1 for the constant ½; can be above 1.
      decay: (r̃_WD − r̃) / r̃_WD; 0 in WD, negative where the policy does better outside.
      decay_points: 100 (r̃_WD − r̃), the loss in points of similarity.
      clipped_share: share of action entries outside the action range before they were clipped.
      channels: each action channel, in order.
    """

    name: str
    epsilon_low: Real
    epsilon_high: Real
    states: Integer
    similarity: Real
    similarity_sd: Real
    mae: Real
    normalised_regret: Real
    decay: Real
    decay_points: Real
    clipped_share: Real
    channels: Annotated[tuple[ChannelReport, ...], Field(strict=False)]


_Regions = Annotated[tuple[RegionReport, ...], Field(strict=False, min_length=1)]


class AgentReport(StrictModel):
    """One agent of a team: every region over the action channels that it owns.

    Attributes:
      regions: WD, then OOD 1, 2, …; `channels` are the agent's own, in order.
      references: the same regions for each reference policy, over the same channels.
    """

    regions: _Regions
    references: dict[str, _Regions]


class EvaluationReport(StrictModel):
    """A policy in every region of a protocol, and the references on the same states.

    Of a team `regions` and `references` are over all action channels, and `agents` has each agent
    over its own. A report of a single agent has none, and its JSON no such field.

    Attributes:
      policy: the policy's name.
      action_range: of the policy's actions, "unit" or "symmetric"; "mixed" where the agents of a
        team differ.
      spec: the task, whole.
      spec_digest: its digest.
      protocol: the protocol, whole.
      protocol_digest: its digest.
      regions: WD, then OOD 1, 2, …
      references: the same regions for each reference policy; what each is, says
        `sme_registry.evaluation.references`.
      agents: each agent of a team by its name, in the order of the channels that they own.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: Literal[1] = 1
    policy: str
    action_range: Literal["unit", "symmetric", "mixed"]
    spec: SMESpec
    spec_digest: str
    protocol: EvaluationProtocol
    protocol_digest: str
    regions: _Regions
    references: dict[str, _Regions]
    agents: dict[str, AgentReport] = Field(default_factory=dict)
    versions: dict[str, str]

    @model_serializer(mode="wrap")
    def _without_agents_of_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        if not self.agents:
            del plain["agents"]
        return plain

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a report.

        Raises:
          MalformedDocumentError: not readable, or not strict JSON.
          SpecError: a field is wrong, missing or unknown.
          DigestMismatchError: a digest is not that of the spec or protocol beside it.
        """
        report = cls.from_dict(read_json(path), str(path))
        for what in ("spec", "protocol"):
            found, stated = getattr(report, what).digest, getattr(report, f"{what}_digest")
            if found != stated:
                raise DigestMismatchError(
                    f"{path}: {what}_digest={stated!r:.90}: its {what} has {found!r}. One of them "
                    "was changed after the evaluation: take the report again from its source."
                )
        return report

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the report as JSON, whole or not at all.

        Raises:
          OptionError: it cannot be written; what stood there is untouched.
        """
        return write_atomically(path, to_json(self.to_dict()))

    def table(self) -> Table:
        """The report for a terminal of 80 columns: regions across, policy and references down.

        Of a team it is the whole team's, and three lines for each agent below.
        """
        from rich.markup import escape
        from rich.table import Table

        spec, own_name = self.spec, escape(self.policy)
        team = f", {len(self.agents)} agents" if self.agents else ""
        table = Table(
            title=f"{own_name} on {catalogue.title(spec)} (S={spec.state_dim}, "
            f"A={spec.action_dim}, L={spec.complexity}{team})\n"
            f"{spec.digest}\n{self.regions[0].states:,} states a region",
            caption=NOT_COMPARABLE,
            title_justify="left",
            caption_justify="left",
        )
        table.add_column("", no_wrap=True)
        for region in self.regions:
            table.add_column(
                f"{region.name}\nε ≤ {region.epsilon_high:g}", justify="right", no_wrap=True
            )

        def row(label: str, regions: _Regions, field: str, pattern: str) -> None:
            values = [format(getattr(region, field), pattern) for region in regions]
            table.add_row(label, *values, style="bold" if regions is self.regions else None)

        for heading, field in (
            ("similarity r̃", "similarity"),
            ("normalised regret", "normalised_regret"),
        ):
            table.add_row(heading, style="italic")
            for name, regions in {own_name: self.regions, **self.references}.items():
                row(f"  {LABELS.get(name, name)}", regions, field, ".3f")
            table.add_section()
        row("SD of r̃ over states", self.regions, "similarity_sd", ".3f")
        row("decay from WD", self.regions, "decay", ".1%")
        row("points of r̃ lost", self.regions, "decay_points", ".1f")
        row("actions clipped", self.regions, "clipped_share", ".1%")
        for agent, found in self.agents.items():
            table.add_section()
            row(f"{agent}  r̃", found.regions, "similarity", ".3f")
            row("  normalised regret", found.regions, "normalised_regret", ".3f")
            linear = found.references.get("linear_least_squares")
            if linear is not None:
                row(f"  of {LABELS['linear_least_squares']}", linear, "normalised_regret", ".3f")
        return table
