"""`Learner`, of which a function of yours is one; `learn`, which trains a run by any `Learner`.

    def train(env, steps, seed):            # `train:module:train` in `sme train -a` and in plans
        ...                                 # takes at most `steps` steps of `env`
        return policy                       # from observations [B, O] to actions [B, A]

`env` is a Gymnasium environment of one task, with the exact regret of each step in its info.
Hyperparameters are keyword arguments. The policy acts in the environment's action space; a model
with `predict`, as those of Stable-Baselines3, and a PyTorch module are policies, too. It is
evaluated once, at the end of its training.

A run goes on from its last checkpoint. Each finished episode is logged with its exact regret.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from rich.console import Console

from sme_registry.compiled.arrays import Array
from sme_registry.envs import SMEEnv
from sme_registry.envs.episodes import Episode, Episodes, info_of_envs
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.io.system import defer_interrupts, working_directory_importable
from sme_registry.io.terminal import Progress
from sme_registry.spec import SMESpec
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.training.algorithms import load_function, short_name
from sme_registry.training.record import (
    CHECKPOINT,
    EPISODES,
    SNAPSHOTS,
    TENSORBOARD,
    EpisodeLog,
    RunRecord,
    Snapshots,
)

_RECENT = 20  # episodes in the running mean that the progress shows


class Watch:
    """What is called while a learner learns; `RunLog` of a run, and another of a study's cell."""

    def on_steps(self) -> None:
        """The learner's environments have taken one or more steps."""

    def on_visit(self, visit: int) -> None:
        """A visit of a stream's phase has ended."""

    def on_pause(self) -> None:
        """The learner has learned from all its steps: a checkpoint may be saved."""

    def prepare(self, note: str) -> None:
        """The learner does something else before its first steps, such as compiling."""


class Learner:
    """What learns in environments of its own: of Stable-Baselines3, in JAX, or a function.

    Attributes:
      steps: environment steps so far.
      total: environment steps at the end; on-policy algorithms collect whole rollouts.
      model: the trained policy, as `evaluate` takes it.
      hyperparameters: those that differ from the defaults.
    """

    steps: Any
    total: Any
    model: Any
    hyperparameters: dict[str, Any]

    def learn(self, watch: Watch) -> None:
        """Take the steps of the run that are left; ValueError where weights are not finite."""

    def add_to(self, sums: Episodes) -> list[Episode]:
        """Add the steps since the last call to sums; returns the episodes that ended in them."""
        return []

    def save(self, path: Path) -> None:
        """Write the model; nothing of one that cannot be saved."""

    def is_finite(self) -> bool:
        """Whether all its weights are finite; also if they are unknown."""
        return True

    def restore(self, checkpoint: Path) -> Array | None:
        """Go on from a checkpoint; returns the sums of the present episodes if these go on, too."""

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        """Write a checkpoint, whole or not at all; `sums` are of the present episodes."""

    def begin_log(self, folder: Path) -> None:
        """Log to TensorBoard in a folder from here on, if it is installed."""

    def log(self, episodes: Sequence[Episode]) -> None:
        """Log finished episodes to TensorBoard."""

    def close(self) -> None:
        """Close the environments and the log."""


def learn(
    learner: Learner, record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode]]:
    """Train and write a model."""
    checkpoint, present = folder / CHECKPOINT, None
    if record.sessions > 1 and checkpoint.exists():
        present = learner.restore(checkpoint)
    learner.begin_log(folder / TENSORBOARD)
    with RunLog(learner, record, folder, progress, console, present) as log:
        try:
            learner.learn(log)
        except ValueError:  # of our environments or of PyTorch, where actions are NaN
            log.check_finite()
            raise
        log.check_finite()
        learner.close()
        with defer_interrupts():
            learner.save(folder / record.model_name)
            return log.write_record(), log.episodes


class RunLog(Watch):
    """The log, the record and the displayed progress of a run, while it trains."""

    def __init__(
        self,
        learner: Learner,
        record: RunRecord,
        folder: Path,
        progress: bool,
        console: Console | None,
        present: Array | None,
    ) -> None:
        team, first_step, total = record.spec.team, learner.steps, learner.total
        self._agents = () if team is None else tuple(agent.name for agent in team.agents)
        self._learner, self._record, self._folder = learner, record, folder
        self._log = EpisodeLog(folder / EPISODES, first_step, self._agents)
        self._wall_before = self.episodes[-1].wall_seconds if self.episodes else 0.0
        self._last_checkpoint = first_step
        self._sums = Episodes(
            record.num_envs,
            record.agents,
            lambda: record.spec,
            steps=first_step,
            clock=lambda: self._wall_seconds,
        )
        if present is not None:
            self._sums.sums[:] = present
        name = short_name(record.algorithm)
        if progress and total > max(first_step, record.steps):
            (console or Console(stderr=True)).print(
                f"{name} collects whole rollouts: {total:,} steps, not {record.steps:,}.",
                style="dim",
            )
        self._progress = Progress(
            f"training {name}", total, done=first_step, console=console, enabled=progress
        )
        self._snapshots: Snapshots | None = None
        if record.stream is not None:
            self._snapshots = Snapshots(folder / SNAPSHOTS, record.stream)
            if first_step == 0:
                learner.save(self._snapshots.initial)

    def __enter__(self) -> RunLog:
        self._progress.__enter__()
        self._start = time.monotonic()
        self._note = self._progress_note()
        return self

    def __exit__(self, *error: Any) -> None:
        self._progress.__exit__(*error)
        self._log.close()

    @property
    def episodes(self) -> list[Episode]:
        return self._log.episodes

    def prepare(self, note: str) -> None:
        self._progress.prepare(note)

    def on_steps(self) -> None:
        finished = self._learner.add_to(self._sums)
        for episode in finished:
            by_agent = (episode.agents_regret or (episode.regret,)) if self._agents else ()
            number = len(self.episodes) + 1
            self._log.add(episode._replace(episode=number, agents_regret=by_agent))
        if finished:
            self._note = self._progress_note()
            self._learner.log(finished)
        self._progress.update(self._sums.steps, self._note)

    def on_visit(self, visit: int) -> None:
        assert self._snapshots is not None  # a task has no visits
        self._learner.save(self._snapshots.visits[visit])

    def on_pause(self) -> None:
        steps = self._sums.steps
        due = steps - self._last_checkpoint >= self._record.checkpoint_every
        if not due and steps < self._learner.total:
            return
        self.check_finite()
        with defer_interrupts():
            self._learner.save_checkpoint(self._folder / CHECKPOINT, self._sums.sums)
            self.write_record()
        self._last_checkpoint = steps

    def write_record(self) -> RunRecord:
        seconds, steps = self._wall_seconds, self._sums.steps
        record = self._record.updated(
            steps_done=steps,
            episodes=len(self.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(steps / max(seconds, 1e-9), 3),
        )
        record.write(self._folder)
        return record

    def check_finite(self) -> None:
        """Raise PolicyError if weights are NaN or infinite; the record says that the run failed."""
        if self._learner.is_finite():
            return
        failure = f"the weights are not finite any longer at step {self._learner.steps:,}"
        record = RunRecord.read(self._folder)  # of its last checkpoint
        if record is not None:
            record.updated(status="failed", failure=failure).write(self._folder)
        path = self._folder / CHECKPOINT
        kept = f"{path} is its last checkpoint" if path.exists() else "it has no checkpoint"
        raise PolicyError(
            f"training: {failure}. The run stays in {self._folder}; {kept}. Train into another "
            "folder with other hyperparameters, such as a lower learning_rate."
        )

    @property
    def _wall_seconds(self) -> float:
        return self._wall_before + time.monotonic() - self._start

    def _progress_note(self) -> str:
        """The phase of a stream, and the mean regret of the last episodes."""
        notes, stream, recent = [], self._record.stream, self.episodes[-_RECENT:]
        if stream is not None:
            segment = stream.times.segment_at(self._sums.steps)
            notes.append(f"phase {stream.segments[segment].phase}")
        if recent:
            regret = np.mean([episode.regret for episode in recent])
            whose = "team's mean regret" if self._agents else "mean regret"
            costs = [episode.safety.cost for episode in recent if episode.safety is not None]
            cost = f", cost {np.mean(costs):.3f}" if costs else ""
            notes.append(f"{whose} {regret:.3f}{cost} (last {len(recent)} episodes)")
        return ", ".join(notes)


class FunctionLearner(Learner):
    """A function `train(env, steps, seed) -> policy` in its environment."""

    def __init__(
        self,
        name: str,
        spec: SMESpec,
        *,
        seed: int,
        steps: int,
        hyperparameters: Mapping[str, Any],
        action_range: ActionRange,
        field: str = "uses",
    ) -> None:
        self._named, self._spec, self._action_range = f"{field}='train:{name}'", spec, action_range
        self._seed, self.total, self.hyperparameters = seed, steps, dict(hyperparameters)
        self._function, self.source = load_function(name, field)
        self.env = CountedEnv(SMEEnv(spec, action_range=action_range), steps, self._named)
        self.model: Any = None
        try:
            inspect.signature(self._function).bind(self.env, steps, seed, **self.hyperparameters)
        except TypeError as error:
            raise OptionError(
                f"{self._named}: cannot be called with an environment, steps, a seed and the "
                f"hyperparameters {sorted(hyperparameters)}: {error}. Define "
                f"{name.partition(':')[2]}(env, steps, seed), and hyperparameters by name."
            ) from None

    @property
    def steps(self) -> int:
        return self.env.steps

    def learn(self, watch: Watch) -> None:
        self.env.after_step = watch.on_steps
        self.env.reset(seed=self._seed)  # so that episodes without a seed are reproducible
        with working_directory_importable():
            self.model = self._function(self.env, self.total, self._seed, **self.hyperparameters)
        is_policy = callable(self.model) or hasattr(self.model, "predict")
        if not is_policy or isinstance(self.model, type):
            raise PolicyError(
                f"{self._named}: returned {self.model!r:.80}: must be a policy. Return a function "
                f"from observations [B, {self._spec.observation_dim}] to actions "
                f"[B, {self._spec.action_dim}], or a model with predict, as those of "
                "Stable-Baselines3."
            )

    def policy(self) -> Policy | TeamPolicy:
        return as_policy(self.model, self._spec, action_range=self._action_range)

    def add_to(self, sums: Episodes) -> list[Episode]:
        reward, terminated, truncated, info = self.env.last
        ended = [terminated or truncated]
        return sums.add([reward], info_of_envs([info]), [terminated], ended)

    def save(self, path: Path) -> None:
        kinds = sys.modules.get("stable_baselines3.common.base_class")
        if kinds is not None and isinstance(self.model, kinds.BaseAlgorithm):
            write_atomically(path, saved_sb3(self.model))

    def close(self) -> None:
        self.env.close()


class CountedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that takes no more than its steps, and counts their regret and CPU seconds.

    `cost` is None without `safety`; `last` is the last step without its observation.
    """

    def __init__(self, env: SMEEnv, budget: int, named: str) -> None:
        super().__init__(env)
        self._budget, self._named = budget, named
        self.steps, self.seconds, self.regret = 0, 0.0, np.zeros(1)
        self.cost: float | None = None if env.sme_spec.safety is None else 0.0
        self.last: tuple[Any, bool, bool, dict[str, Any]] = (0.0, False, False, {})
        self.after_step: Callable[[], None] = lambda: None

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.steps >= self._budget:
            raise PolicyError(
                f"{self._named}: takes more than {self._budget:,} steps: must stop at the steps "
                "that it is given. Choose rollouts and evaluations of your own that fit, or give "
                "more steps."
            )
        begun = time.thread_time()
        result = self.env.step(action)
        self.seconds += time.thread_time() - begun
        info = result[4]
        self.steps += 1
        self.regret += info["regret"]
        if self.cost is not None:
            self.cost += info["cost"]
        self.last = (float(result[1]), *result[2:])
        self.after_step()
        return result
