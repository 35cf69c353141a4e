"""`ReportFile`: what reports have in common: files, digests in them, and tables as text."""

from __future__ import annotations

import io
import os
from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec.document import StrictModel, refuse_other_digest

if TYPE_CHECKING:
    from sme_registry.io.tables import Table


class ReportFile(StrictModel):
    """A report that a file can hold, and that prints as a table.

    Attributes:
      documents: the fields that are documents; a field `<document>_digest` has the digest of each.
    """

    documents: ClassVar[tuple[str, ...]]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a report."""
        report = cls.from_dict(read_json(path), str(path))
        for what in cls.documents:
            refuse_other_digest(
                getattr(report, f"{what}_digest"),
                getattr(report, what),
                f"{path}: {what}_digest",
                "Get the report from its source again, or repeat the evaluation.",
            )
        return report

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the report as JSON, completely or not at all."""
        return write_atomically(path, to_json(self.to_dict()))

    @abstractmethod
    def table(self) -> Table:
        """The report as a table."""

    def tables(self) -> list[Table]:
        """All tables of the report."""
        return [self.table()]

    def chart(self) -> str:
        """A curve as SVG; empty for a report without one."""
        return ""

    def _repr_html_(self) -> str:
        """The curve and the tables, for notebooks."""
        from sme_registry.io.markup import card, table_html

        return card(self.chart(), *map(table_html, self.tables()))

    def __str__(self) -> str:
        return "\n\n".join(map(as_text, self.tables()))


def as_text(table: Table) -> str:
    """A table as plain text."""
    from rich.console import Console

    # Wide, so that no column wraps; a table is only as wide as its content.
    console = Console(file=io.StringIO(), width=1000, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())
