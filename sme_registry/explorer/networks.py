"""The networks of a task and of its policies as programs.

Every program of a task has the same input, a *point* x = (s, d, t/T, r_cum/k): S state channels, m
distractors, and the two other entries of an observation. Source: METHOD, sections 1, 5, 8 and 9.

    optimal(x)      π*(s)                         `[B, A]`
    limit(x)        ℓ(s) = 1 − 2τ v(s)            `[B, A]`, with safety
    observe(x)      (M(s, d), t/T, r_cum/k)       `[B, S + m + 2]`, rounded to float32
    policy(o)       actions of the unit range     `[B, A]` of observations, not clipped
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sme_registry.errors import PolicyError, ResourceLimitError
from sme_registry.evaluation import OfflinePolicy, Perceptron, Policy, TeamPolicy
from sme_registry.evaluation.models import ModulePredictor, OnnxNetwork
from sme_registry.evaluation.references import References
from sme_registry.explorer.graph import read_onnx
from sme_registry.explorer.program import Program, ProgramBuilder
from sme_registry.export.network import of_offline_policy
from sme_registry.export.torch_modules import traced
from sme_registry.spec import SMESpec
from sme_registry.task import Task, streams
from sme_registry.task.draw import Array

__all__ = [
    "TOLERANCE",
    "constant",
    "limit",
    "linear",
    "observe",
    "optimal",
    "point_width",
    "policy_program",
    "probe_points",
]

TOLERANCE = 1e-5  # of an action in [0, 1]; a policy's own float32 sums move it by 1e-6
_PROBES = 256


def point_width(spec: SMESpec) -> int:
    """Entries of a point: S + m + 2."""
    return spec.state_dim + spec.distractors + 2


def optimal(task: Task) -> Program:
    """π* of a point; of a team, each agent's from what it observes."""
    spec = task.spec
    build = ProgramBuilder(point_width(spec), "π*")
    actions = [
        build.layers(build.columns(0, tuple(observed)), layers)
        for observed, layers in zip(task.observed, task.policies, strict=True)
    ]
    build.concat(*actions)
    return build.build()


def limit(task: Task) -> Program | None:
    """ℓ of a point; None without safety."""
    if task.spec.safety is None:
        return None
    build = ProgramBuilder(point_width(task.spec), "the network of the limits")
    v = build.layers(build.columns(0, tuple(range(task.spec.state_dim))), task.limiting)
    build.affine(v, -2.0 * task.spec.safety.tightness, 1.0)
    return build.build()


def observe(task: Task) -> Program:
    """What the policy sees in a point, rounded to float32."""
    spec = task.spec
    n = spec.state_dim + spec.distractors
    build = ProgramBuilder(point_width(spec), "the mixing")
    x = 0
    if spec.observation is not None and spec.observation.mixing != "none":
        x = build.columns(0, tuple(range(n)))
        if spec.observation.mixing == "orthogonal":
            ((W, b),) = task.mixing
            x = build.dense(x, W, b)
        else:
            x = build.layers(x, task.mixing)
        x = build.concat(x, build.columns(0, (n, n + 1)))
    build.unary("round32", x)
    return build.build()


def linear(task: Task, fitted: References) -> Program:
    """The linear least-squares policy of a report, of a point."""
    build = ProgramBuilder(point_width(task.spec), "the linear policy")
    s = build.columns(0, tuple(range(task.spec.state_dim)))
    build.dense(s, fitted.slope.T.copy(), fitted.intercept - 0.5 * fitted.slope.sum(axis=0))
    return build.build()


def constant(task: Task, action: Array) -> Program:
    """One action `[A]` in every point."""
    build = ProgramBuilder(point_width(task.spec), "the constant policy")
    build.constant(action)
    return build.build()


def policy_program(policy: Policy | TeamPolicy, spec: SMESpec) -> Program | None:
    """A policy's network as a program of observations; None if it is not known as one.

    The program is used only if its actions equal the policy's own in probes inside and outside the
    cube, to `TOLERANCE`.
    """
    build = ProgramBuilder(spec.observation_dim)
    try:
        if isinstance(policy, TeamPolicy):
            known = _append_team(build, policy, spec)
        else:
            known = _append(build, 0, policy)
    except ResourceLimitError:
        return None
    if not known:
        return None
    program = build.build()
    observations = probe_points(spec).astype(np.float32)
    expected, actions = (np.clip(act(observations), 0.0, 1.0) for act in (policy, program))
    # NaN counts as a difference.
    return program if bool(np.all(np.abs(actions - expected) <= TOLERANCE)) else None


def probe_points(spec: SMESpec) -> Array:
    """Points to compare in, the second half of them in the cube of twice the side."""
    n = point_width(spec)
    x = streams.uniform(0, "explorer/probes", _PROBES * n).reshape(_PROBES, n)
    x[_PROBES // 2 :] = 2.0 * x[_PROBES // 2 :] - 0.5
    return x


def _append(build: ProgramBuilder, observation: int, policy: Policy) -> bool:
    """Add a policy's actions in the unit range; False if its network is unknown."""
    act: Any = policy.act
    if isinstance(act, OfflinePolicy):
        act = of_offline_policy(act)
    if isinstance(act, Perceptron):
        x = _append_perceptron(build, observation, act)
    elif isinstance(act, Program):
        x = build.append(act, observation)
    else:
        data = None
        if isinstance(act, OnnxNetwork):
            data = act.path.read_bytes()
        elif isinstance(act, ModulePredictor):
            data = _exported(act, build.width(observation))
        network = None if data is None else read_onnx(data)
        if network is None or network.inputs != build.width(observation):
            return False
        x = build.append(network, observation)
    if policy.action_range == "symmetric":
        build.affine(x, 0.5, 0.5)
    return True


def _append_perceptron(build: ProgramBuilder, x: int, network: Perceptron) -> int:
    for W, b, activation in network.layers:
        x = build.dense(x, np.ascontiguousarray(W.T), b)
        if activation == "silu":
            x = build.binary("mul", x, build.unary("sigmoid", x))
        elif activation == "elu":
            x = build.unary("elu", x, alpha=1.0)
        elif activation != "identity":
            x = build.unary(activation, x)
    if network.low is not None and network.high is not None:
        half = 0.5 * (network.high.astype(np.float64) - network.low)
        x = build.binary("add", build.binary("mul", x, half), network.low + half)
    return x


def _append_team(build: ProgramBuilder, team: TeamPolicy, spec: SMESpec) -> bool:
    """Add the joint actions of a team; False if the network of any agent is unknown."""
    n = point_width(spec)
    actions = []
    for member in team.members:
        # What an agent sees of the joint observation is an affine map; these rows tell it.
        nothing = member.observe(np.zeros((1, n), np.float32))[0]
        each = member.observe(np.eye(n, dtype=np.float32)) - nothing
        seen = build.dense(0, each.T.copy(), nothing)
        if not _append(build, seen, member.policy):
            return False
        actions.append(build.columns(build.last, tuple(range(member.action_dim))))
    build.concat(*actions)
    return True


def _exported(act: ModulePredictor, observation_dim: int) -> bytes | None:
    """A module as ONNX; None if PyTorch cannot export it."""
    try:
        return traced(act.module, observation_dim)
    except PolicyError:
        return None
