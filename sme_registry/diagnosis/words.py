"""A diagnosis for people: as Markdown, and for a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from sme_registry.diagnosis.report import Comparison, Diagnosis
from sme_registry.evaluation.report import LABELS
from sme_registry.spec import catalogue

if TYPE_CHECKING:
    from rich.console import RenderableType

_KINDS = {"where": "Where the error sits", "why": "Why"}
_COLOURS = {"yes": "bold red", "no": "green", "cannot tell": "yellow"}


def title(diagnosis: Diagnosis) -> str:
    """What was diagnosed, on what."""
    spec = diagnosis.spec
    return (
        f"{diagnosis.name} on {catalogue.title(spec)} (S={spec.state_dim}, A={spec.action_dim}, "
        f"L={spec.complexity}, k={spec.k}, r_min={spec.r_min:g}, D={spec.D:g})"
    )


def terminal(diagnosis: Diagnosis) -> Iterable[RenderableType]:
    """What `sme diagnose` prints, part by part."""
    from rich.markup import escape
    from rich.table import Table

    yield f"[bold]{escape(title(diagnosis))}[/]"
    for text in (diagnosis.note, diagnosis.headline):
        if text:
            yield escape(text)
    yield ""
    for kind, heading in _KINDS.items():
        table = Table(title=heading, title_justify="left", show_header=False, box=None)
        table.add_column(style="cyan", no_wrap=True, min_width=19)
        table.add_column(no_wrap=True, min_width=11)
        table.add_column(overflow="fold")
        for found in diagnosis.findings:
            if found.kind == kind:
                answer = f"[{_COLOURS[found.answer]}]{found.answer}[/]"
                table.add_row(found.question, answer, escape(found.text))
        yield table
    if diagnosis.comparison is not None:
        yield ""
        heads, rows = _comparison_rows(diagnosis.comparison)
        table = Table(
            title=escape(_differing(diagnosis.comparison)),
            title_justify="left",
            box=None,
        )
        for head in heads:
            table.add_column(escape(head), justify="left" if head == heads[0] else "right")
        for row in rows:
            table.add_row(*map(escape, row))
        yield table


def markdown(diagnosis: Diagnosis, figures: Sequence[str] = ()) -> str:
    """The diagnosis as a page, with the figures beside it."""
    numbers = diagnosis.numbers
    lines = [f"# {title(diagnosis)}", "", diagnosis.headline, ""]
    lines += [diagnosis.note, ""] if diagnosis.note else []
    lines += [
        "ν is the mean |a − a*| over that of the constant ½: 0 for the optimum. In brackets "
        "stand the thresholds that decided.",
        "",
    ]
    for kind, heading in _KINDS.items():
        lines += [f"## {heading}", ""]
        rows = [
            (found.question, f"**{found.answer}**", found.text)
            for found in diagnosis.findings
            if found.kind == kind
        ]
        lines += [*_table(("question", "answer", "evidence"), rows), ""]
    if diagnosis.comparison is not None:
        lines += ["## Beside another run", "", _differing(diagnosis.comparison), ""]
        lines += [*_table(*_comparison_rows(diagnosis.comparison)), ""]
        if diagnosis.comparison.answers:
            changed = [(q, *pair) for q, pair in diagnosis.comparison.answers.items()]
            lines += [*_table(("answer to", "here", "there"), changed), ""]
    lines += ["## Beside the references", ""]
    on_policy = numbers.on_policy.scores
    scores = [
        (
            LABELS.get(who, who) or "**this policy**",
            f"{score.regret:.3f}",
            f"{score.normalised:.3f}",
            *((f"{on_policy[who].regret:.3f}", f"{on_policy[who].normalised:.3f}")
              if who in on_policy else ("0.000", "0.000")),
        )
        for who, score in numbers.uniform.items()
    ]  # fmt: skip
    of_policies = ("policy", "regret, uniform states", "ν", "regret, its own episodes", "ν")
    lines += [*_table(of_policies, scores), "", "## Action channels", ""]
    channels = [
        (
            str(c.channel), f"{c.error:.3f}", f"{c.normalised:.3f}", f"{c.linear:.3f}",
            f"{c.regret:.3f}", f"{c.offset:+.3f}", f"{c.slope:.2f}", f"{c.at_zero:.1%}",
            f"{c.at_one:.1%}",
        )
        for c in numbers.channels
    ]  # fmt: skip
    of_channels = (
        "channel", "error", "ν", "ν of linear", "regret", "offset", "slope", "at 0", "at 1",
    )  # fmt: skip
    lines += [*_table(of_channels, channels), ""]
    for name in figures:
        lines += [f"![{name.rsplit('.', 1)[0].replace('_', ' ')}]({name})", ""]
    versions = ", ".join(f"{name} {version}" for name, version in diagnosis.versions.items())
    lines += [f"Task `{diagnosis.spec_digest}`. Versions: {versions}.", ""]
    return "\n".join(lines)


def _differing(comparison: Comparison) -> str:
    fields = {**comparison.spec_fields, **comparison.plan_fields}
    said = "; ".join(
        f"{name}: {here} here, {there} there" for name, (here, there) in fields.items()
    )
    return f"Against {comparison.name}. {said or 'Nothing'} differs."


def _comparison_rows(comparison: Comparison) -> tuple[Sequence[str], list[Sequence[str]]]:
    rows: list[Sequence[str]] = [
        (d.what, f"{d.here:.3f}", f"{d.there:.3f}", f"{d.here - d.there:+.3f}")
        for d in comparison.differences
    ]
    return ("", "here", "there", "difference"), rows


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return [line(heads), "|" + "---|" * len(heads), *map(line, rows)]
