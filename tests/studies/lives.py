"""A study with streams whose lives were lived by hand-made agents: exact reports of known verdicts.

At the end of a visit an agent plays a = ½ + w (a* − ½) with the optimum a* of the visited phase, so
its normalised regret on that phase is 1 − w.

    Forgetful   learns each phase as a fresh agent does, and keeps nothing of the others
    Tired       does so with a smaller w in each visit: it loses plasticity
    Stubborn    learns the first phase, and never anything again
"""

import numpy as np

from sme_registry import materialize
from sme_registry.evaluation import (
    dynamic_regret,
    evaluate,
    evaluate_stream,
    reference_regret,
)
from sme_registry.evaluation.retention import final_specs
from sme_registry.spec import StreamSpec
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.result import CellResult, LearningCurve, Timing
from tests.studies.cells import file_of

AGENTS = ("Forgetful", "Tired", "Stubborn")
TASK = {"state_dim": 2, "action_dim": 2, "complexity": 2, "horizon": 10, "hidden_width": 8}
TIMING = Timing(total=2.0, training=1.0, environment=0.5, evaluation=0.5, steps_per_second=100.0)


def stream(*specs, cycles=1):
    return {"phases": [{"spec": TASK | spec, "steps": 100} for spec in specs], "cycles": cycles}


STREAMS = {
    "Switch": stream({"seed": 1}, {"seed": 2}, {"seed": 3}),
    "Related": stream({"seed": 1}, {"seed": 1, "rotation": 0.3}, {"seed": 1, "rotation": 0.6}),
    "Cycle": stream({"seed": 1}, {"seed": 2}, cycles=2),
}


def stream_study(seeds=5, **fields):
    """The plan; each stream has two draws."""
    fields = {
        "streams": [
            {"name": name, "stream": each, "draws": [0, 1]} for name, each in STREAMS.items()
        ],
        "algorithms": [
            {"name": name, "uses": "PPO", "hyperparameters": {"agent": name}} for name in AGENTS
        ],
        "seeds": seeds,
        "evaluations": 12,
        "protocol": {"states_per_region": 30, "epsilons": [0.5, 1.0]},
    } | fields
    return file_of("lived", **fields)


def live(file, folder, leave_out=lambda planned: False):
    """Write a plan and the results of the cells of its streams, except for those left out."""
    ledger = Ledger(folder)
    ledger.write_plan(file)
    for key, cell in {p.cell.digest: p.cell for p in file.plan.cells if not leave_out(p)}.items():
        ledger.write(lived(cell, key))
    return ledger


def lived(cell, key):
    """The result of a life, or of a fresh agent."""
    alone = cell.stream is None or len(cell.stream.phases) == 1
    document = cell.document
    specs = final_specs(document) if isinstance(document, StreamSpec) else (document,)
    visits = range(document.cycles * len(specs) if isinstance(document, StreamSpec) else 1)
    shares = [_share(cell, v, alone=alone) for v in visits]
    steps = np.arange(10, cell.steps + 1, 10)
    regrets = np.repeat([0.5 * (1.0 - w) for w in shares], cell.steps // 10 // len(shares))
    evaluated = slice(None, None, max(1, len(steps) // max(1, cell.evaluations)))
    curve = LearningCurve(
        steps=steps[evaluated].tolist(),
        **{name: regrets[evaluated].tolist() for name in ("regret", "similarity")},
        episode_return=(10.0 * (1.0 - regrets[evaluated])).tolist(),
        length=[10.0] * len(steps[evaluated]),
    )
    common = {
        "key": key, "cell": cell, "curve": curve, "timing": TIMING, "versions": {"numpy": "2"},
        "online_regret": float(regrets.mean()),
    }  # fmt: skip
    policies = [_policy(spec, w) for spec, w in _plays(cell, specs, shares)]
    if not isinstance(document, StreamSpec):
        report = evaluate(policies[0], document, cell.protocol, name="agent")
        return CellResult(report=report, **common)
    life = evaluate_stream(policies, document, cell.protocol, initial="constant", name="agent")
    log = dynamic_regret(document, steps, regrets, 10)
    references = reference_regret(document, frozen=policies[0], training=log, episodes=20)
    life = life.with_dynamic_regret(log).with_reference_regret(references)
    return CellResult(stream_report=life, **common)


def _share(cell, visit, *, alone):
    """w at the end of a visit; a little different in each run."""
    noise = 0.04 * np.random.default_rng([cell.seed, visit]).random()
    if alone or cell.hyperparameters.get("agent") != "Tired":
        return float(0.8 - noise)
    return float(0.8 / (1.0 + visit) - noise)


def _plays(cell, specs, shares):
    """The task whose optimum is played at the end of each visit, and its share."""
    if cell.hyperparameters.get("agent") == "Stubborn":
        return [(specs[0], shares[0])] * len(shares)
    return [(specs[v % len(specs)], share) for v, share in enumerate(shares)]


def _policy(spec, share):
    task = materialize(spec)
    return lambda observations: (
        0.5
        + share * (task.optimal_action(observations[:, : spec.state_dim].astype(np.float64)) - 0.5)
    )
