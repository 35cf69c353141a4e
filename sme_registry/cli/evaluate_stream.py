"""`sme evaluate` on a stream: the policies of a life to a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sme_registry.cli.files import can_draw, print_tables, print_written
from sme_registry.errors import OptionError
from sme_registry.io import refuse_existing
from sme_registry.io.terminal import Progress, err, print_json
from sme_registry.spec import EvaluationProtocol, StreamSpec

if TYPE_CHECKING:
    from sme_registry.evaluation import StreamReport


class Life(NamedTuple):
    """The policies of a life, as the command line has them.

    Attributes:
      policies: at the end of each visit; or one, which acts for the whole life and learns nothing.
      initial: before training.
      fresh: of an agent for each phase, trained on that phase alone.
      action_range: of all of them, as in `evaluate`.
      algorithm: as in `evaluate`.
    """

    policies: list[str]
    initial: str | None
    fresh: list[str] | None
    action_range: str | None
    algorithm: str | None


def evaluate_life(
    life: Life, stream: StreamSpec, protocol: str, folder: Path | None, *, force: bool, json: bool
) -> None:
    """Evaluate the policies of a life in a stream; print the report, and write it with figures.

    Raises:
      SMEError: see `evaluate_stream`; or the folder has a report, and `force` is false.
    """
    from sme_registry.evaluation import resolve_protocol
    from sme_registry.plots.streams import FILE

    resolved = resolve_protocol(protocol)
    target = None if folder is None else folder / FILE
    if target is not None:
        refuse_existing(target, force=force)
    report = _evaluated(life, stream, resolved)
    files = [] if target is None else [report.write(target), *_figures(report, target.parent)]
    if json:
        print_json(report.to_dict())
    else:
        print_tables(report.tables())
    print_written(files)


def _evaluated(life: Life, stream: StreamSpec, protocol: EvaluationProtocol) -> StreamReport:
    from sme_registry import evaluation

    stream.refuse_many_visits()
    visits = stream.visits
    policies: list[Any] = [*life.policies]
    if len(policies) not in (1, visits):
        raise OptionError(
            f"{len(policies)} policies: must be one for the whole life, or {visits}, one at the "
            "end of each visit."
        )
    frozen = None
    if len(policies) == 1:
        frozen = evaluation.as_policy(
            policies[0],
            stream.phases[0].spec,
            action_range=life.action_range,
            algorithm=life.algorithm,
            observed_phases=stream.observed_phases,
        )
        policies = [frozen] * visits
    states = protocol.states_per_region * len(protocol.edges)
    with Progress("evaluating", states, unit="states", console=err()) as progress:
        report = evaluation.evaluate_stream(
            policies,
            stream,
            protocol,
            initial=life.initial,
            fresh=life.fresh,
            action_range=life.action_range,
            algorithm=life.algorithm,
            progress=progress.update_of,
        )
    report = report.with_reference_regret(evaluation.reference_regret(stream))
    if frozen is None:
        return report
    return report.with_dynamic_regret(evaluation.expected_regret([frozen] * visits, stream))


def _figures(report: StreamReport, folder: Path) -> list[Path]:
    if not can_draw():
        return []
    from sme_registry.plots.files import write_stream

    return write_stream(report, folder)
