"""A task of each kind, a policy of known actions, and its report."""

import functools

import numpy as np

from sme_registry import SMESpec, evaluate, materialize
from sme_registry.evaluation import regions
from sme_registry.spec import EvaluationProtocol

PROTOCOL = EvaluationProtocol(states_per_region=2_000)
SMALL = EvaluationProtocol(states_per_region=200, epsilons=(1.0,))

PLAIN = SMESpec(state_dim=4, action_dim=3, complexity=3)
SAFE = SMESpec(state_dim=4, action_dim=3, complexity=2, r_min=0.2, safety={"tightness": 0.3})
DISTRACTORS = 5
DISTRACTED = SMESpec(state_dim=4, action_dim=3, observation={"distractors": DISTRACTORS})
AGENTS = [
    {"name": "left_0", "action_dim": 1, "observes": [0, 2]},
    {"name": "right_0", "action_dim": 3, "observes": [1, 2, 3]},
    {"name": "right_1", "action_dim": 2},
]
NAMES = tuple(agent["name"] for agent in AGENTS)
WIDTHS = tuple(agent["action_dim"] for agent in AGENTS)
TEAM = SMESpec(state_dim=4, action_dim=6, complexity=3, team={"agents": AGENTS})


def half(width):
    return lambda observations: np.full((len(observations), width), 0.5)


def linear(observations):
    return 0.2 + 0.6 * observations[:, :3]


def distracted(observations):
    """Reads a distractor for each action channel."""
    return 0.25 + 0.3 * observations[:, :3] + 0.2 * observations[:, 4:7]


def slanted(agent):
    scale = (0.3 + 0.3 * agent) * np.ones(WIDTHS[agent])
    return lambda observations: 0.3 + observations[:, -3:-2] * scale


SLANTED = {name: slanted(agent) for agent, name in enumerate(NAMES)}
KINDS = {
    "plain": (linear, PLAIN),
    "team": (SLANTED, TEAM),
    "safe": (linear, SAFE),
    "distracted": (distracted, DISTRACTED),
}


@functools.cache
def report_of(kind):
    return evaluate(*KINDS[kind], PROTOCOL)


def optimal_of(spec):
    task = materialize(spec)
    return lambda observations: task.optimal_action(observations[:, : spec.state_dim])


def observations(protocol, region, spec, rows=None):
    """All observations of a region of a task whose agents see the state, `[N, S + 2]`."""
    batches = regions.states(protocol, region, spec, rows)
    return np.concatenate([batch.observation(batch.s, spec.horizon) for batch in batches])


def numbers(report):
    """Every number of a report, its agents', and those of limits and distractors."""

    def below(value):
        if isinstance(value, dict):
            for part in value.values():
                yield from below(part)
        elif isinstance(value, list | tuple):
            for part in value:
                yield from below(part)
        elif isinstance(value, int | float):
            yield value

    fields = ("regions", "references", "agents", "safety", "observation")
    document = report.to_dict()
    return list(below([document.get(field) for field in fields]))
