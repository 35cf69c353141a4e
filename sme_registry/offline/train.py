"""`train_offline`: BC or IQL on a data set, judged while it learns and at its end.

While it learns, episodes are played in the known task: the score is mean r̃ over their steps, beside
the mean r̃ of the set's own transitions, which is exact. At the end it is judged within and out of
distribution, as any policy is.

The folder of a training:
    offline.json      what was trained, on what, and every evaluation on the way
    policy.npz        the policy, for `OfflinePolicy.load` and `sme evaluate`
    evaluation.json   its report; decay_curve.png where matplotlib is installed
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from sme_registry.datasets import Dataset, Transitions, open_dataset
from sme_registry.errors import (
    DigestMismatchError,
    MissingDependencyError,
    OptionError,
    PolicyError,
    SpecError,
)
from sme_registry.evaluation import EvaluationReport, evaluate, resolve_protocol
from sme_registry.evaluation.policies.npz import Layer, OfflinePolicy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.offline.hyperparameters import (
    BCHyperparameters,
    Hyperparameters,
    hyperparameters_of,
    known_algorithm,
)
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Integer, Real, StrictModel, plain_number
from sme_registry.task import Task, load_spec, materialize, streams
from sme_registry.training.record import installed_versions

if TYPE_CHECKING:
    from sme_registry.offline.networks import Learner

RECORD = "offline.json"
POLICY = "policy.npz"
EVALUATION = "evaluation.json"
DECAY_CURVE = "decay_curve.png"
_OWN_FILES = (RECORD, POLICY, EVALUATION, DECAY_CURVE)

EPISODES = 10  # METHOD, section 4
MAX_STEPS = 10**9
_TOLD_EVERY = 50  # steps
_CHECKED_ROWS = 64
_TOLERANCE = 1e-6  # of π* between machines, as a file's fingerprint has it

Progress = Callable[[int, int, str], None]


class LiveScore(StrictModel):
    """Episodes of the policy, played in the task.

    Attributes:
      step: gradient steps done.
      similarity: mean r̃ over all steps of all episodes: the score.
      similarity_sd: standard deviation of r̃ over these steps.
      episode_return: mean return of the episodes.
      losses: terms of the loss of the last batch, by name.
    """

    step: Integer
    similarity: Real
    similarity_sd: Real
    episode_return: Real
    losses: dict[str, Real]


class BehaviourScore(StrictModel):
    """The data set's own transitions, exactly.

    Attributes:
      similarity: mean r̃ over them.
      similarity_sd: standard deviation of r̃ over them.
      step_reward: mean r over them.
    """

    similarity: Real
    similarity_sd: Real
    step_reward: Real


class OfflineRecord(StrictModel):
    """What was trained, on what, and what came of it.

    Attributes:
      algorithm: "bc" or "iql".
      hyperparameters: all of them, as used.
      seed: of the initial weights, the shuffles, and where the live episodes begin.
      steps, batch_size: gradient steps, and transitions in each.
      episodes: of each live evaluation.
      dataset: the id of the set; null where only its arrays were given.
      dataset_digest: of its arrays.
      recipe_digest: of what the set was made from; null as `dataset`.
      transitions: N of the set.
      spec, spec_digest: the task.
      behaviour: what the set itself scores.
      evaluations: on the way, in order; the last is of the policy returned.
      wall_seconds, cpu_seconds: of the training, its live evaluations included.
      cpu_ms_per_step: of a gradient step alone.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: Literal[1] = 1
    algorithm: Literal["bc", "iql"]
    hyperparameters: dict[str, Any]
    seed: Integer
    steps: Integer
    batch_size: Integer
    episodes: Integer
    dataset: str | None
    dataset_digest: str
    recipe_digest: str | None
    transitions: Integer
    spec: SMESpec
    spec_digest: str
    behaviour: BehaviourScore
    evaluations: Annotated[tuple[LiveScore, ...], Field(strict=False, min_length=1)]
    wall_seconds: Real
    cpu_seconds: Real
    cpu_ms_per_step: Real
    versions: dict[str, str]

    @property
    def score(self) -> float:
        """Mean r̃ of the trained policy's live episodes."""
        return self.evaluations[-1].similarity

    @property
    def improvement(self) -> float:
        """The score less the behaviour's."""
        return self.score - self.behaviour.similarity

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> OfflineRecord:
        """Read the record of a training.

        Raises:
          MalformedDocumentError: not readable, or not strict JSON.
          SpecError: a field is wrong, missing or unknown.
          DigestMismatchError: `spec_digest` is of another spec.
        """
        record = cls.from_dict(read_json(path), str(path))
        if record.spec.digest != record.spec_digest:
            raise DigestMismatchError(
                f"{os.fspath(path)}: spec_digest={record.spec_digest!r}: its spec has "
                f"{record.spec.digest!r}. One of them was changed: train again."
            )
        return record


@dataclass(frozen=True)
class OfflineResult:
    """A finished training.

    Attributes:
      policy: from observations `[B, S + 2]` to actions `[B, A]`; what `evaluate` takes.
      record: what `offline.json` holds.
      report: the policy within and out of distribution.
      folder: where everything was written; None where it was not.
    """

    policy: OfflinePolicy
    record: OfflineRecord
    report: EvaluationReport
    folder: Path | None


def train_offline(
    data: Dataset | Transitions | str | os.PathLike[str],
    *,
    algorithm: str = "iql",
    steps: int = 20_000,
    batch_size: int = 256,
    seed: int = 0,
    evaluations: int = 20,
    episodes: int = EPISODES,
    hyperparameters: Mapping[str, Any] | None = None,
    spec: SMESpec | dict[str, Any] | str | os.PathLike[str] | None = None,
    protocol: EvaluationProtocol | dict[str, Any] | str | os.PathLike[str] | None = None,
    folder: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> OfflineResult:
    """Train BC or IQL on a data set, on the CPU, one thread. The same arguments, the same bits.

    On one machine, that is: other processors and builds of PyTorch round differently.

    Args:
      data: a data set, its id or its path; or its arrays, with `spec`.
      algorithm: "bc" or "iql", in any case.
      steps: gradient steps, at least 1.
      batch_size: transitions in each, in [1, N]. Each transition comes once before any comes again.
      seed: in [0, 2**53): of initial weights, shuffles, and the live episodes' starts, which depend
        on nothing else, so that both algorithms are played from the same ones.
      evaluations: how many live evaluations, evenly spaced, in [1, steps]; the last is at the end.
      episodes: of each of them, in [1, 4096].
      hyperparameters: changes to the defaults, see `offline.hyperparameters`.
      spec: the task that arrays are of: a spec, its fields, an id, a digest or a path.
      protocol: where it is judged at the end; None takes the set's own, and "paper-v1" for arrays.
      folder: where to write; made if missing. None writes nothing.
      force: replace what a training left in the folder.
      progress: called with the steps done, the steps in all, and a note.

    Returns:
      The policy, the record and the report.

    Raises:
      UnknownNameError: no such data set, algorithm, task or protocol.
      SpecError: a hyperparameter is unknown or out of range, or the task is a team's.
      OptionError: another argument is outside its range, or the folder holds something else.
      MalformedDocumentError, DigestMismatchError: the set cannot be read, or was changed.
      PolicyError: the training diverged.
      MissingDependencyError: PyTorch, or for a file Minari, is not installed.
    """
    algorithm = known_algorithm(algorithm)
    settings = hyperparameters_of(algorithm, hyperparameters)
    steps = _whole("steps", steps, 1, MAX_STEPS)
    seed = _whole("seed", seed, 0, 2**53 - 1)
    evaluations = _whole("evaluations", evaluations, 1, steps)
    episodes = _whole("episodes", episodes, 1, 4096)
    target = _claimed(folder, force)
    source = _opened(data, spec)
    resolved = _single(load_spec(source.recipe.spec if source is not None else spec))  # type: ignore[arg-type]
    judged_by = resolve_protocol(
        protocol if protocol is not None else source.recipe.protocol if source else "paper-v1"
    )
    _require_torch()
    task = materialize(resolved)
    transitions = data if isinstance(data, Transitions) else source.transitions()  # type: ignore[union-attr]
    _refuse_other_task(transitions, task)
    batch_size = _whole("batch_size", batch_size, 1, len(transitions), "transitions of the set")

    begun, begun_cpu = time.perf_counter(), time.process_time()
    layers: Any = ()
    scores: list[LiveScore] = []
    learning = 0.0
    about = {
        "algorithm": algorithm,
        "seed": seed,
        "steps": steps,
        "dataset_digest": transitions.digest,
        "spec_digest": resolved.digest,
    }

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, steps, f"live r̃ {scores[-1].similarity:.3f}" if scores else "")

    due = [round(steps * (index + 1) / evaluations) for index in range(evaluations)]
    for step, losses, layers, seconds in _learn(settings, transitions, batch_size, seed, due, tell):
        learning += seconds
        playing = OfflinePolicy(layers, about)
        scores.append(_live(playing, task, seed, len(scores), episodes, step, losses))
    policy = OfflinePolicy(layers, about)
    wall, cpu = time.perf_counter() - begun, time.process_time() - begun_cpu
    record = OfflineRecord(
        algorithm=algorithm,  # type: ignore[arg-type]
        hyperparameters=settings.to_dict(),
        seed=seed,
        steps=steps,
        batch_size=batch_size,
        episodes=episodes,
        dataset=None if source is None else source.id,
        dataset_digest=transitions.digest,
        recipe_digest=None if source is None else source.record.recipe_digest,
        transitions=len(transitions),
        spec=resolved,
        spec_digest=resolved.digest,
        behaviour=BehaviourScore(
            similarity=float(transitions.similarities.mean()),
            similarity_sd=float(transitions.similarities.std()),
            step_reward=float(transitions.step_rewards.mean()),
        ),
        evaluations=tuple(scores),
        wall_seconds=round(wall, 3),
        cpu_seconds=round(cpu, 3),
        cpu_ms_per_step=round(1e3 * learning / steps, 4),
        versions=installed_versions(),
    )
    report = evaluate(policy, resolved, judged_by, name=algorithm.upper())
    if target is not None:
        _write(target, policy, record, report)
    return OfflineResult(policy, record, report, target)


class _Learnt(NamedTuple):
    """Where a training is when an evaluation is due."""

    step: int
    losses: dict[str, float]
    layers: list[Layer]
    cpu_seconds: float  # of the steps since the one before


def _learn(
    settings: Hyperparameters,
    transitions: Transitions,
    batch_size: int,
    seed: int,
    due: Sequence[int],
    tell: Callable[[int], None],
) -> Iterator[_Learnt]:
    """Train up to each of the steps that are due, in order.

    PyTorch's threads and its global generator are as they were whenever this is not running.
    """
    import torch

    from sme_registry.offline.bc import BC
    from sme_registry.offline.iql import IQL
    from sme_registry.offline.networks import Batches, weights

    initial, shuffles = (streams.raw_bits(seed, "offline/learner", 2) >> np.uint64(1)).tolist()
    dims = transitions.observations.shape[1], transitions.actions.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(initial)
        learner: Learner = (
            BC(*dims, settings) if isinstance(settings, BCHyperparameters) else IQL(*dims, settings)
        )
    batches = iter(Batches(transitions, batch_size, torch.Generator().manual_seed(shuffles)))
    done = 0
    for until in due:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        begun = time.process_time()
        try:
            while done < until:
                losses = learner.step(next(batches))
                done += 1
                if done % _TOLD_EVERY == 0:
                    tell(done)
        finally:
            torch.set_num_threads(threads)
        seconds = time.process_time() - begun
        found = {name: float(loss.detach()) for name, loss in losses.items()}
        layers = weights(learner.actor)
        finite = all(np.isfinite(part).all() for layer in layers for part in layer)
        if not finite or not np.isfinite(list(found.values())).all():
            raise PolicyError(
                f"training diverged before step {done}: weights or losses are no longer finite. "
                "Give a smaller learning_rate."
            )
        yield _Learnt(done, found, layers, seconds)
        tell(done)


def _live(
    policy: OfflinePolicy,
    task: Task,
    seed: int,
    evaluation: int,
    episodes: int,
    step: int,
    losses: dict[str, float],
) -> LiveScore:
    done = rollouts(policy, task, start_states(seed, evaluation, episodes, task.spec.state_dim))
    return LiveScore(
        step=step,
        similarity=done.per_step(done.similarity),
        similarity_sd=done.similarity_sd,
        episode_return=float(done.episode_return.mean()),
        losses=losses,
    )


def _whole(name: str, value: Any, low: int, high: int, of: str = "") -> int:
    number = plain_number(value)
    if isinstance(number, bool) or not isinstance(number, int) or not low <= number <= high:
        why = f", the {of}" if of else ""
        raise OptionError(f"{name}={value!r:.60}: must be an integer in [{low}, {high}]{why}.")
    return number


def _opened(data: Any, spec: Any) -> Dataset | None:
    """The data set on disk, its metadata read; None for arrays."""
    if isinstance(data, Transitions):
        if spec is None:
            raise OptionError("spec=None: arrays do not say what task they are of. Give its spec.")
        return None
    if not isinstance(data, Dataset | str | os.PathLike):
        raise OptionError(
            f"data={data!r:.60}: must be a data set, its id, its path, or its Transitions."
        )
    opened = data if isinstance(data, Dataset) else open_dataset(data)
    if spec is not None and (digest := load_spec(spec).digest) != opened.record.spec_digest:
        raise OptionError(
            f"spec={digest[:19]}…: the set is of {opened.record.spec_digest[:19]}…. Leave it out."
        )
    return opened


def _single(spec: SMESpec) -> SMESpec:
    if spec.team is not None:
        raise SpecError(
            f"team: the set is of {len(spec.team.agents)} agents, and a policy of all that is "
            "observed is none that they could follow. Train on a set of a single agent."
        )
    return spec


def _require_torch() -> None:
    if importlib.util.find_spec("torch") is None:
        raise MissingDependencyError(
            "offline training: PyTorch is not installed. Run `pip install 'sme-registry[offline]'`."
        )


def _refuse_other_task(transitions: Transitions, task: Task) -> None:
    """Raise where the arrays are of another task, or cannot be learnt from."""
    S, A = task.spec.state_dim, task.spec.action_dim
    shapes = {"observations": S + 2, "actions": A, "next_observations": S + 2}
    for name, width in shapes.items():
        found = getattr(transitions, name).shape
        if found != (len(transitions), width):
            raise OptionError(
                f"{name} of shape {found}: must be ({len(transitions)}, {width}) for state_dim={S},"
                f" action_dim={A}. Give the spec that the set is of."
            )
    if len(transitions) == 0:
        raise OptionError("transitions=0: there is nothing to learn from. Give a set with rows.")
    for name in (*shapes, "rewards", "states"):
        if not np.isfinite(getattr(transitions, name)).all():
            raise OptionError(f"{name}: has NaN or infinite entries. Give finite numbers.")
    rows = np.linspace(0, len(transitions) - 1, min(_CHECKED_ROWS, len(transitions))).astype(int)
    optimal = task.optimal_action(transitions.states[rows])
    off = np.abs(optimal - transitions.optimal_actions[rows]).max()
    if not off <= _TOLERANCE:
        raise OptionError(
            f"spec={task.spec.digest[:19]}…: is not the task of the set: its optimal actions are "
            f"up to {off:.2g} away from the set's. Give the spec that the set is of."
        )


def _claimed(folder: str | os.PathLike[str] | None, force: bool) -> Path | None:
    """The folder to write to, made sure of before the work.

    Raises:
      OptionError: it is a file, or holds what must not be replaced.
    """
    if folder is None:
        return None
    target = Path(folder)
    if target.exists() and not target.is_dir():
        raise OptionError(f"folder={str(target)!r}: is a file. Give a folder, or a new name.")
    names = [path.name for path in target.glob("*")] if target.exists() else []
    strangers = sorted(name for name in names if name not in _OWN_FILES)
    if strangers:
        raise OptionError(
            f"folder={str(target)!r}: holds files that are no training's, such as "
            f"{strangers[0]!r}. Give an empty or a new folder."
        )
    if names and not force:
        raise OptionError(
            f"folder={str(target)!r}: holds a training. Give another folder, or --force (in Python "
            "force=True) to replace it."
        )
    return target


def _write(
    folder: Path, policy: OfflinePolicy, record: OfflineRecord, report: EvaluationReport
) -> None:
    """Policy and report first: where the record is, everything is."""
    (folder / RECORD).unlink(missing_ok=True)
    policy.save(folder / POLICY)
    report.write(folder / EVALUATION)
    if importlib.util.find_spec("matplotlib") is not None:
        from sme_registry import plots

        plots.decay_curve(report, folder / DECAY_CURVE)
    write_atomically(folder / RECORD, to_json(record.to_dict()))
