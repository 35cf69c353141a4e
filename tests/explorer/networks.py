"""Random networks as policies of a task, in several forms."""

import numpy as np

from sme_registry import SMESpec, materialize
from sme_registry.evaluation import Perceptron
from sme_registry.evaluation.networks import OfflinePolicy

HIDDEN = 24


def arrays(*shape, seed=0, scale=0.5):
    return np.random.default_rng((*shape, seed)).normal(scale=scale, size=shape).astype(np.float32)


def perceptron(spec, activation="tanh", squashed=False):
    """A random network for a task's observations and actions."""
    n, A = spec.observation_dim, spec.action_dim
    layers = [
        (arrays(n, HIDDEN), arrays(HIDDEN), activation),
        (arrays(HIDDEN, HIDDEN, seed=1), arrays(HIDDEN, seed=1), activation),
        (arrays(HIDDEN, A), arrays(A) + 0.5, "tanh" if squashed else "identity"),
    ]
    if not squashed:
        return Perceptron(layers)
    return Perceptron(layers, np.full(A, -1.0, np.float32), np.ones(A, np.float32))


def fitted(spec, squashed=False, agent=0):
    """The same with a last layer that makes it a fair policy; of a team, for one agent."""
    task = materialize(spec)
    S, m, own = spec.state_dim, spec.distractors, task.owned[agent]
    points = np.random.default_rng(5).random((2000, S + m + 2))
    points[:, -1] = 0.0
    seen = observations(spec, points)[:, [*task.observed[agent], *range(S, S + m + 2)]]
    shape = SMESpec(state_dim=seen.shape[1] - 2, action_dim=own.stop - own.start)
    network = perceptron(shape, "tanh", squashed)
    target = task.optimal_action(points[:, :S])[:, own]
    if squashed:
        target = np.arctanh(np.clip(2.0 * target - 1.0, -0.99, 0.99))
    h = np.concatenate([network.hidden(seen)[-1], np.ones((len(seen), 1))], axis=1)
    *W, b = np.linalg.lstsq(h, target, rcond=None)[0]
    layers = [*network.layers[:-1], (np.array(W), b, network.layers[-1][2])]
    return Perceptron(layers, network.low, network.high)


def offline(spec):
    n, A = spec.observation_dim, spec.action_dim
    return OfflinePolicy([(arrays(HIDDEN, n), arrays(HIDDEN)), (arrays(A, HIDDEN), arrays(A))])


def observations(spec, points):
    """What a policy sees in points (s, d, t/T, r_cum/k), by the task's own methods."""
    task, S, m = materialize(spec), spec.state_dim, spec.distractors
    seen = points[:, :S]
    if spec.observation is not None:
        seen = task.seen(points[:, :S], points[:, S : S + m])
    return np.concatenate([seen, points[:, S + m :]], axis=1).astype(np.float32)
