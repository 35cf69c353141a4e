"""What notebooks show of an environment: its spaces and its episodes, then its task."""

from __future__ import annotations

from typing import Any

from sme_registry.io.markup import card, folded, pairs_html, table_html
from sme_registry.spec import SMESpec, StreamSpec, cards

_STATUS = {"created": "not begun", "running": "running", "ended": "ended"}


def html(
    env: Any,
    observation: Any,
    action: Any,
    *,
    status: str | None = None,
    autoreset: str | None = None,
) -> str:
    """A card of an environment, single or batched; a team's has its agents in place of the spaces.

    Args:
      env: the environment, whose `repr` is the title, and whose `document` is shown.
      observation: the space of a single lane.
      action: likewise; of any agent in a team.
      status: of the episode: "created", "running" or "ended"; None for a batch.
      autoreset: the mode of a batch.
    """
    document: SMESpec | StreamSpec = env.document
    agents = cards.agents(document) if isinstance(document, SMESpec) else []
    span = f"float32 in [{action.low.flat[0]:g}, {action.high.flat[0]:g}]"
    facts = {
        "observation": f"[{observation.shape[0]}] float32 in [0, 1]: {_observed(document)}",
        "action": f"[{action.shape[0]}] {span}",
    }
    if agents:
        facts = {"actions": span}
    facts["episode"] = f"at most {document.horizon:,} steps"
    if status is not None:
        facts["episode"] += f"; {_STATUS[status]}"
    if autoreset is not None:
        facts["autoreset"] = autoreset
    shown = [pairs_html(repr(env), facts)]
    if agents:
        shown.append(table_html(cards.agents_table(agents)))
    if isinstance(document, SMESpec):
        summary = cards.difference(document)
        task = [table_html(cards.task_table(document))]
    else:
        summary = f"Stream: {document.visits:,} visits, {document.steps:,} steps"
        task = cards.parts(document)
    return card(*shown, folded(summary, *task))


def _observed(document: SMESpec | StreamSpec) -> str:
    if isinstance(document, SMESpec):
        return cards.observation_text(document)
    phase = ", one-hot of the phase" if document.observes_phase else ""
    return cards.observation_text(document.phases[0].spec) + phase
