"""The numbers of the gallery, which take minutes to measure: kept in a file, by name and digest.

A released digest never changes its numbers, so only what the file lacks is measured.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sme_registry import evaluate
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.task.certificate import certify

from .entries import document, entries

FILE = Path(__file__).parent / "measured.json"
PROTOCOL = "quick-v1"
CHECKS = {
    "constant_policy_reward": "reward of ½",
    "constant_policy_similarity": "similarity r̃ of ½",
    "agent_constant_policy_similarity": "r̃ of ½ of one agent, the farthest from ¾",
    "channel_spread": "spread of π*",
    "linear_policy_reward": "reward of the linear policy",
    "broken_limits": "share of limits that π* breaks",
    "price_of_safety": "price of the projection",
    "mixing_linear_r2": "R² of a linear map that undoes the mixing",
}
"""The checks that a card shows, and what it calls them; the others ask whether a task is broken."""
REFERENCES = {
    "linear": "linear",
    "random": "random",
    "safe_projection": "safe projection",
    "shrunk_optimal": "shrunk optimum",
}
"""The reference policies of a card; π* has N = 0 and ½ has N = 1 everywhere."""


def certified(spec: SMESpec) -> dict[str, Any]:
    """The outcome of `certify`, and the values of `CHECKS` that the task has."""
    certificate = certify(spec)
    values = {check.name: check.value for check in certificate.checks}
    checks = {name: _rounded(v) for name in CHECKS if (v := values.get(name)) is not None}
    return {"outcome": certificate.outcome, "checks": checks}


def measure(task: SMESpec | StreamSpec) -> dict[str, Any]:
    """What the card of a task or a stream shows; values have four digits.

    Returns:
      Of a task `outcome` and `checks` of `certify`, and `references`: N₀ and N̄ of each. Of a
      stream `phases`: the outcome and the checks of each phase's task.
    """
    if isinstance(task, StreamSpec):
        known: dict[str, Any] = {}
        for phase in task.phases:
            if phase.spec.digest not in known:
                known[phase.spec.digest] = certified(phase.spec)
        return {"phases": [known[phase.spec.digest] for phase in task.phases]}
    report = evaluate("optimal", task, protocol=PROTOCOL)
    references = {}
    for name in REFERENCES:
        if name in report.references:
            cube, *shells = (region.normalised_regret for region in report.references[name])
            references[name] = [_rounded(cube), _rounded(sum(shells) / len(shells))]
    return {**certified(task), "references": references}


def measured() -> dict[str, dict[str, Any]]:
    """The numbers of every entry of the catalogue, by its name; writes those it measures."""
    kept = read_json(FILE) if FILE.exists() else {}
    numbers: dict[str, dict[str, Any]] = {}
    for name, file in entries().items():
        if kept.get(name, {}).get("digest") != file.digest:
            print(f"measuring {name}", flush=True)
            kept[name] = {"digest": file.digest, **measure(document(file))}
            write_atomically(FILE, to_json(kept))  # after each, so that it can be resumed
        numbers[name] = kept[name]
    if kept != numbers:  # an entry left the catalogue
        write_atomically(FILE, to_json(numbers))
    return numbers


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
