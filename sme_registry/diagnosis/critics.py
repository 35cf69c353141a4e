"""A critic against the truth: does it rank actions as the task does, and is its level right?

Source: METHOD, section 11. A critic is compared with the policy that its targets assume:

    PPO          V of the clipped Gaussian
    SAC          min Q of the policy's mode, then its samples, with −α log π added at every step
    TD3, DDPG    min Q of the actor, then the actor with its target noise
    IQL          min Q, of its ranking alone: its targets assume no policy that could be played
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sme_registry.datasets.offline import CRITICS, POLICY
from sme_registry.diagnosis.measure import states_of
from sme_registry.envs.arguments import single_agent
from sme_registry.envs.batch import Batch
from sme_registry.errors import PolicyError
from sme_registry.evaluation import regions
from sme_registry.evaluation.models import evaluating, load_sb3
from sme_registry.evaluation.networks import OfflineCritic, OfflinePolicy
from sme_registry.evaluation.rollouts import expected_returns, play, value_after_end
from sme_registry.io import integer_in
from sme_registry.spec import EvaluationProtocol
from sme_registry.spec.document import Digest, Integer, Real, StrictModel, TupleOf
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task import Task
from sme_registry.task.loading import load_task
from sme_registry.task.task import Array, Mask, Observation

VISITED = "visited"
_TRIED, _SPREAD = 16, 0.1  # actions of a state that are ranked: N(0, spread) around the policy's
_TIMES = 10  # parts of an episode in the profile of levels


class CriticRegion(StrictModel):
    """A critic in some states.

    Attributes:
      region: "visited", "WD" or "OOD m".
      states: how many.
      ranking: share of pairs of actions, around the policy's in one state, that the critic orders
        as the step reward does: ½ is chance, 1 perfect. Null for V, and where no two differ.
      misled_ranking: the same against the reward that shaping leaves to a learner of this γ; null
        without shaping, too.
      claim: mean of what the critic says. Null of IQL, as all that follows.
      finite: mean exact value to the end of the episode.
      continuing: mean exact value of going on after it, which an agent that bootstraps at a
        truncation estimates; null at γ = 1.
      bias: claim minus the value that it should estimate.
      bias_share: the bias over the mean size of that value.
    """

    region: str
    states: Integer
    ranking: Real | None = None
    misled_ranking: Real | None = None
    claim: Real | None = None
    finite: Real | None = None
    continuing: Real | None = None
    bias: Real | None = None
    bias_share: Real | None = None


class CriticTime(StrictModel):
    """Mean levels in a part of the episode, over states of the cube."""

    time: Real  # mean t/T
    claim: Real
    finite: Real
    continuing: Real | None


class CriticReport(StrictModel):
    """What a run's critic says, and the exact values (METHOD, section 11).

    Attributes:
      kind: "V" of states, "Q" of states and actions.
      sweeps: τ times the updates of the targets. Null of V, and of IQL.
      regions: visited states, the cube, and five shells.
      times: levels over t/T; none of IQL.
    """

    algorithm: str
    kind: Literal["V", "Q"]
    spec_digest: Digest
    gamma: Real
    sweeps: Real | None
    seed: Integer
    regions: TupleOf[CriticRegion]
    times: TupleOf[CriticTime]

    def region(self, name: str) -> CriticRegion:
        return next(region for region in self.regions if region.region == name)


class _Points(NamedTuple):
    """States at any time of an episode, and what the agent sees there."""

    s: Array
    t: Any
    r_cum: Array
    d: Array
    observation: Observation

    @classmethod
    def of(cls, task: Task, s: Array, t: Any, r_cum: Array, d: Array) -> _Points:
        batch = Batch(task, len(s))
        batch.place(s, t, r_cum[:, None], d)
        return cls(s, t, r_cum, d, batch.observe())


class OfflineAgent:
    """What IQL's critics claim of actions of [0, 1], and its policy."""

    name = "IQL"
    kind: Literal["Q"] = "Q"
    sweeps = None

    def __init__(self, folder: Path) -> None:
        self.mode = OfflinePolicy.load(folder / POLICY)
        self._critics = [OfflineCritic.load(folder / name) for name in CRITICS]
        self.gamma = float(self._critics[0].about["discount"])
        self.observation_shape = (self.mode.observation_dim,)

    @classmethod
    def of(cls, model: Any) -> OfflineAgent | None:
        """The agent in the folder of an offline training, or of its policy; or None."""
        if isinstance(model, cls):
            return model
        if not isinstance(model, str | Path):
            return None
        folder = Path(model).parent if str(model).endswith(".npz") else Path(model)
        return cls(folder) if (folder / CRITICS[0]).exists() else None

    def __call__(self, observations: Observation) -> Array:
        return np.asarray(self.mode(observations), np.float64)

    def claim(self, observations: Observation, actions: Array) -> Array:
        inputs = np.concatenate([observations, 2.0 * actions - 1.0], axis=1, dtype=np.float32)
        claims = [critic(inputs)[:, 0] for critic in self._critics]
        return np.asarray(np.min(claims, axis=0), np.float64)


class _Critic:
    """What an SB3 model claims, and the policy whose value that is; actions are of [0, 1]."""

    def __init__(self, model: Any, seed: int) -> None:
        import torch

        # On the CPU: numbers do not depend on where a model is, and arrays are NumPy's.
        on_cpu = model.policy.device.type == "cpu"
        self._network = model.policy if on_cpu else copy.deepcopy(model.policy).cpu()
        self._torch = torch
        self.observation_shape = model.observation_space.shape
        self._generator = torch.Generator().manual_seed(seed)
        self.name = type(model).__name__
        self.gamma = float(model.gamma)
        self.sweeps: float | None = None
        self.bonus: Any = 0.0
        self.kind: Literal["V", "Q"] = "Q"
        if hasattr(model.policy, "predict_values"):
            self.kind = "V"
            self._low, self._high = model.action_space.low, model.action_space.high
            self._sample: Callable[[Any], Any] = self._of_gaussian
        elif hasattr(model, "target_policy_noise"):
            self._noise = float(model.target_policy_noise), float(model.target_noise_clip)
            self._sample = self._of_actor
        else:
            entropy = getattr(model, "log_ent_coef", None)
            constant = getattr(model, "ent_coef_tensor", 0.0)
            self._alpha = float(constant if entropy is None else entropy.detach().exp())
            self._sample = self._of_squashed
        if self.kind == "Q":
            every = getattr(model, "policy_delay", getattr(model, "target_update_interval", 1))
            self.sweeps = float(model.tau * model._n_updates / every)

    def __call__(self, observations: Observation) -> Array:
        """Actions `[B, A]` that the policy samples; `bonus` is of them."""
        with evaluating(self._network), self._torch.no_grad():
            return _to_unit(self._sample(self._tensor(observations)))

    def mode(self, observations: Observation) -> Array | None:
        """The deterministic actions `[B, A]`, of which Q is asked; None of V."""
        if self.kind == "V":
            return None
        with evaluating(self._network), self._torch.no_grad():
            # The squashed mean of SAC's Gaussian, the output of TD3's actor.
            return _to_unit(self._network._predict(self._tensor(observations), deterministic=True))

    def claim(self, observations: Observation, actions: Array | None) -> Array:
        """V `[B]`, or the smallest Q `[B]` of actions."""
        seen = self._tensor(observations)
        with evaluating(self._network), self._torch.no_grad():
            if actions is None:
                return np.asarray(self._network.predict_values(seen)[:, 0], np.float64)
            # SB3's off-policy critics take actions in [−1, 1] in every action space.
            claims = self._network.critic(seen, self._tensor(2.0 * actions - 1.0))
            return np.asarray(self._torch.cat(claims, dim=1).min(dim=1).values, np.float64)

    def _tensor(self, array: Any) -> Any:
        return self._torch.as_tensor(np.asarray(array, np.float32), device="cpu")

    def _normal(self, like: Any) -> Any:
        return self._torch.randn(like.shape, generator=self._generator)

    def _of_gaussian(self, seen: Any) -> Any:
        gaussian = self._network.get_distribution(seen).distribution
        drawn = np.asarray(gaussian.mean + gaussian.stddev * self._normal(gaussian.mean))
        clipped = np.clip(drawn, self._low, self._high)
        return 2.0 * (clipped - self._low) / (self._high - self._low) - 1.0

    def _of_actor(self, seen: Any) -> Any:
        action = self._network.actor(seen)
        spread, clip = self._noise
        noise = (spread * self._normal(action)).clamp(-clip, clip)
        return (action + noise).clamp(-1.0, 1.0)

    def _of_squashed(self, seen: Any) -> Any:
        mean, log_std, _ = self._network.actor.get_action_dist_params(seen)
        noise = self._normal(mean)
        action = self._torch.tanh(mean + log_std.exp() * noise)
        density = -0.5 * noise**2 - log_std - 0.5 * np.log(2.0 * np.pi)
        log_prob = (density - self._torch.log(1.0 - action**2 + 1e-6)).sum(dim=1)
        self.bonus = -self._alpha * np.asarray(log_prob, np.float64)
        return action


def critic(model: Any, task: SpecLike | Task, *, states: int = 500, seed: int = 0) -> CriticReport:
    """Compare the critic of a Stable-Baselines3 model with the exact values of its policy.

    Args:
      model: PPO, TD3, SAC or DDPG, as a model or the path of its .zip (which can run code of its
        author), as `sme train` writes it for agents in JAX too; or the folder of an offline
        training with IQL, of which only the ranking is known.
      states: of each region.
      seed: of states, of noise and of sampled actions.

    Example:
      >>> from sme_registry.diagnosis import critic
      >>> report = critic("runs/ppo/model.zip", "Default", states=100)
      >>> report.kind
      'V'
    """
    task = single_agent(load_task(task))
    integer_in("states", states, 1)
    integer_in("seed", seed, 0)
    learnt = _critic_of(model, task, seed)
    points = {VISITED: _visited(task, learnt, states, seed)} | {
        regions.region_name(region): _drawn(task, states, seed, region)
        for region in range(len(EvaluationProtocol().edges))
    }
    levels: dict[str, _Levels] = {}
    if isinstance(learnt, _Critic):
        tail = value_after_end(task, learnt, learnt.gamma, seed) if learnt.gamma < 1 else None
        levels = {name: _Levels.of(task, learnt, at, tail, seed) for name, at in points.items()}
    return CriticReport(
        algorithm=learnt.name,
        kind=learnt.kind,
        spec_digest=task.spec.digest,
        gamma=learnt.gamma,
        sweeps=learnt.sweeps,
        seed=seed,
        regions=tuple(
            _region(task, learnt, name, at, levels.get(name), seed) for name, at in points.items()
        ),
        times=tuple(_times(task, points["WD"], levels["WD"])) if levels else (),
    )


def ranking_in_cube(model: Any, task: Task, states: int, seed: int) -> float | None:
    """The ranking of a model's critic in the cube alone; None where `critic` has none."""
    if not has_critic(model, task):
        return None
    learnt = _critic_of(model, task, seed)
    if learnt.kind == "V":
        return None
    return _rankings(task, learnt, _drawn(task, states, seed), seed)[0]


def has_critic(model: Any, task: Task) -> bool:
    """Whether `critic` can compare the critic of a model on this task."""
    expected = (task.spec.observation_dim,)
    if isinstance(model, OfflineAgent):
        return model.observation_shape == expected
    return _is_read(model) and model.observation_space.shape == expected


def _is_read(model: Any) -> bool:
    """Whether a model is one whose critic, and the policy that it is of, are known here."""
    module = type(model).__module__
    if not module.startswith("stable_baselines3."):
        return False
    return any(hasattr(model.policy, critic) for critic in ("predict_values", "critic"))


def _critic_of(model: Any, task: Task, seed: int) -> _Critic | OfflineAgent:
    learnt: _Critic | OfflineAgent | None = OfflineAgent.of(model)
    if learnt is None:
        model = load_sb3(model) if isinstance(model, str | Path) else model
        if not _is_read(model):
            raise PolicyError(
                f"model: {type(model).__name__} has no critic that is known here. Give a PPO, "
                "A2C, TD3, SAC or DDPG of Stable-Baselines3, or its .zip; or the folder of an "
                "offline training with IQL."
            )
        learnt = _Critic(model, seed)
    seen, expected = learnt.observation_shape, (task.spec.observation_dim,)
    if seen != expected:
        raise PolicyError(
            f"model: its observations have shape {seen}, and this task's {expected}. Give the task "
            "that it was trained on; of a stream with an observed phase, critics are not compared."
        )
    return learnt


def _to_unit(symmetric: Any) -> Array:
    return np.asarray((np.asarray(symmetric, np.float64) + 1.0) / 2.0)


def _drawn(task: Task, states: int, seed: int, region: int = 0) -> _Points:
    """States of a region at uniform times, with nothing accumulated."""
    batch = states_of(task.spec, states, seed, region)
    t = np.floor(batch.time * task.spec.horizon).astype(np.int64)
    return _Points.of(task, np.asarray(batch.s, np.float64), t, np.zeros(len(t)), batch.d)


def _visited(task: Task, learnt: _Critic | OfflineAgent, states: int, seed: int) -> _Points:
    """States that the policy visits, at random times of its episodes."""
    spec = task.spec
    batch = Batch(task, max(16, -(-2 * states // spec.horizon)))
    for env in range(batch.num_envs):
        batch.seed(env, seed + env)
    batch.begin(np.arange(batch.num_envs), batch.observe())
    rows: list[tuple[Array, ...]] = []
    for steps, step in enumerate(play(batch, lambda _, seen: learnt(seen))):
        waiting = step.observation[:, spec.state_dim + spec.distractors + 1] * float(spec.k)
        time = np.full(len(waiting), steps)
        parts = step.state, time, waiting.astype(np.float64), step.distractors
        rows.append(tuple(part[step.running] for part in parts))
    s, t, r_cum, d = (np.concatenate(column) for column in zip(*rows, strict=True))
    chosen = np.random.default_rng(seed).permutation(len(s))[:states]
    return _Points.of(task, s[chosen], t[chosen], r_cum[chosen], d[chosen])


class _Levels(NamedTuple):
    """What the critic says of points, and exact values, `[N]`."""

    claim: Array
    finite: Array
    continuing: Array | None

    @property
    def estimated(self) -> Array:
        return self.finite if self.continuing is None else self.continuing

    def means(self, rows: Any = ...) -> dict[str, Any]:
        levels = self._asdict().items()
        return {name: None if of is None else float(of[rows].mean()) for name, of in levels}

    @classmethod
    def of(cls, task: Task, learnt: _Critic, at: _Points, tail: float | None, seed: int) -> _Levels:
        mode = learnt.mode(at.observation)
        finite, left = expected_returns(
            task, learnt, at.s, t=at.t, gamma=learnt.gamma, seed=seed,
            r_cum=at.r_cum, distractors=at.d, actions=mode,
        )  # fmt: skip
        continuing = None if tail is None else finite + left * tail
        return cls(learnt.claim(at.observation, mode), finite, continuing)


def _region(
    task: Task,
    learnt: _Critic | OfflineAgent,
    name: str,
    at: _Points,
    levels: _Levels | None,
    seed: int,
) -> CriticRegion:
    fields: dict[str, Any] = {}
    if learnt.kind == "Q":
        fields["ranking"], fields["misled_ranking"] = _rankings(task, learnt, at, seed)
    if levels is not None:
        bias = float((levels.claim - levels.estimated).mean())
        share = bias / max(abs(float(levels.estimated.mean())), 1e-9)
        fields |= {**levels.means(), "bias": bias, "bias_share": share}
    return CriticRegion(region=name, states=len(at.s), **fields)


def _times(task: Task, at: _Points, levels: _Levels) -> Iterator[CriticTime]:
    part = at.t * _TIMES // task.spec.horizon
    for chosen in (part == i for i in range(_TIMES)):
        if chosen.any():
            time = float(at.t[chosen].mean() / task.spec.horizon)
            yield CriticTime(time=time, **levels.means(chosen))


def _rankings(
    task: Task, learnt: _Critic | OfflineAgent, at: _Points, seed: int
) -> tuple[float | None, float | None]:
    """Shares of pairs that the critic orders as the step reward, and as what misleads it."""
    spec, gamma = task.spec, learnt.gamma
    mode = learnt.mode(at.observation)
    assert mode is not None
    noise = np.random.default_rng(seed).normal(0.0, _SPREAD, (_TRIED, *mode.shape))
    actions = np.clip(mode + noise, 0.0, 1.0)  # [tried, N, A]
    claims = np.array([learnt.claim(at.observation, a) for a in actions])
    rewards = np.array([task.step_reward(at.s, a) for a in actions])
    dead = rewards < spec.D
    ranking = _share_in_order(claims, rewards, dead)
    if spec.shaping is None:
        return ranking, None
    later = np.array([task.potential(task.transition(at.s, a), at.t + 1) for a in actions])
    payout = np.minimum(spec.k - 1 - at.t % spec.k, spec.horizon - 1 - at.t)
    misleading = (spec.shaping.discount - gamma) * np.where(dead, 0.0, later)
    return ranking, _share_in_order(claims, gamma**payout * rewards + misleading, dead)


def _share_in_order(claims: Array, truth: Array, dead: Mask) -> float | None:
    """Of pairs that differ, and of which one lives on, the share ordered alike; None of none."""
    first, second = np.triu_indices(len(claims), 1)
    difference = truth[first] - truth[second]
    counted = (difference != 0) & ~(dead[first] & dead[second])
    alike = np.sign(claims[first] - claims[second]) == np.sign(difference)
    return float(alike[counted].mean()) if counted.any() else None
