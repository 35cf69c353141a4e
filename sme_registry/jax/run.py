"""A program from a name and hyperparameters, and its run: advance, evaluate where due, finish.

program = new_program("jax:PPO", specs, seeds, hyperparameters={"n_steps": 512}, steps=100_000)
run(program, due=[50_000, 100_000], start_states=..., on_log=..., on_evaluation=...)
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any

import jax
import numpy as np

from sme_registry.errors import OptionError, SpecError, UnknownNameError
from sme_registry.io import choice
from sme_registry.jax.networks import AgentSettings, Weights, hidden_layers
from sme_registry.jax.ppo import PPO, PPOProgram
from sme_registry.jax.program import PIECE, Array, Document, Evaluation, Program, StepLog
from sme_registry.jax.td3_sac import SAC, TD3, SACProgram, TD3Program

ALGORITHMS: dict[str, tuple[Any, type[Program]]] = {
    "PPO": (PPO, PPOProgram),
    "TD3": (TD3, TD3Program),
    "SAC": (SAC, SACProgram),
}
"""Hyperparameters and program of each algorithm."""

_OnEvaluation = Callable[[int, int, Evaluation], Any]
_OnVisit = Callable[[int, list[dict[str, Array]]], Any]


def hyperparameters_of(uses: str) -> type[AgentSettings]:
    """The model of an algorithm's hyperparameters."""
    model: type[AgentSettings] = _algorithm(uses)[0]
    return model


def settings_of(uses: str, hyperparameters: Mapping[str, Any]) -> Any:
    """An algorithm's hyperparameters, JSON values by SB3's names."""
    try:
        return hyperparameters_of(uses).from_dict(dict(hyperparameters), "hyperparameters")
    except SpecError as error:
        raise OptionError(str(error)) from None


def new_program(
    uses: str,
    specs: Sequence[Document],
    seeds: Sequence[int],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    action_range: str = "symmetric",
    steps: int,
    runs: int | None = None,
    device: str | None = None,
) -> Program:
    """A program of new runs, `jax:PPO`, `jax:TD3` or `jax:SAC`; its callers check the arguments.

    Tasks or streams are of equal shapes, and streams switch at the same steps. `seeds` in
    [0, 2**32) are of weights, starts and noise, and `steps` those of each run. Copies of the first
    run fill up to `runs`.
    """
    _, program = _algorithm(uses)
    return program(
        settings_of(uses, hyperparameters or {}),
        specs,
        seeds,
        steps=steps,
        action_range=action_range,
        runs=runs,
        device=device,
    )


def policy_of(
    uses: str,
    weights: Mapping[str, Array],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    action_range: str = "symmetric",
) -> Callable[[Array], Array]:
    """The deterministic policy of weights, from observations `[B, O]` to actions `[B, A]`."""
    _, program = _algorithm(uses)
    settings, symmetric = settings_of(uses, hyperparameters or {}), action_range == "symmetric"

    def act(observations: Array) -> Array:
        return np.asarray(_actions(program.act, settings, symmetric, dict(weights), observations))

    return act


def hidden_of(
    uses: str, weights: Mapping[str, Array], hyperparameters: Mapping[str, Any]
) -> Callable[[Array], list[Array]]:
    """The outputs `[B, H]` of each hidden layer of that policy, of observations `[B, O]`."""
    _, program = _algorithm(uses)
    layers = len(settings_of(uses, hyperparameters).net_arch)

    def hidden(observations: Array) -> list[Array]:
        outputs = _hidden(*program.hidden, layers, dict(weights), observations)
        return [np.asarray(output) for output in outputs]

    return hidden


@functools.partial(jax.jit, static_argnames=("act", "settings", "symmetric"))
def _actions(
    act: Any, settings: Any, symmetric: bool, weights: Weights, observations: Array
) -> jax.Array:
    actions: jax.Array = act(settings, weights, observations, symmetric)
    return actions


@functools.partial(jax.jit, static_argnames=("prefix", "activation", "layers"))
def _hidden(
    prefix: str, activation: Any, layers: int, weights: Weights, observations: jax.Array
) -> list[jax.Array]:
    return hidden_layers(weights, prefix, observations, layers, activation)


def run(
    program: Program,
    *,
    due: Sequence[int] = (),
    start_states: Callable[[int], Sequence[Array]] | None = None,
    on_log: Callable[[StepLog], Any],
    on_evaluation: _OnEvaluation | None = None,
    on_visit: _OnVisit | None = None,
    after_piece: Callable[[], Any] = lambda: None,
    piece: int = PIECE,
) -> None:
    """Run a program to its end, from its start or from where it was restored.

    Evaluations are those of a study's cell: the k-th one has the weights of step `due[k]`, before
    an update that follows it; the last one waits for the end and the last update. Visits of a
    stream's phases end as in `training.record`.

    Args:
      due: steps of the evaluations, increasing.
      start_states: the initial states of the k-th evaluation, `[episodes, S]` of each run.
      on_log: called with the steps after each piece.
      on_evaluation: called with k, the step, and the evaluation of all runs.
      on_visit: called with the index of a visit that has ended and the weights of each run.
      after_piece: called after each piece and its evaluations, when the state may be saved.
      piece: most steps between two calls; on-policy programs finish their rollout.
    """
    steps = list(due[:-1])
    together = _most_at_once(steps, program.rollout)
    stream = program.lives.stream
    visits = [] if stream is None or on_visit is None else [*stream.visit_ends()]

    def evaluate(after: int) -> None:
        reached = [(k, step) for k, step in enumerate(steps) if after < step <= program.steps]
        _evaluate(program, reached, start_states, together, on_evaluation)

    if program.steps == 0:
        evaluate(after=-1)
    while program.steps < program.budget:
        before = program.steps
        upcoming = [step for step in [*steps, *(end for _, end in visits)] if step > before]
        on_log(program.advance(min([before + piece, program.budget, *upcoming])))
        evaluate(after=before)
        _end_visits(program, visits[:-1], before, on_visit)
        after_piece()
    if program.budget:
        program.finish()
    _end_visits(program, visits[-1:], -1, on_visit)
    last = [(k, program.steps) for k in range(len(steps), len(due))]
    _evaluate(program, last, start_states, together, on_evaluation)


def _evaluate(
    program: Program,
    due: Sequence[tuple[int, int]],
    start_states: Callable[[int], Sequence[Array]] | None,
    together: int,
    on_evaluation: _OnEvaluation | None,
) -> None:
    """Evaluate these indices and steps with the present weights, tasks by tasks."""
    if start_states is None or on_evaluation is None:
        return
    for _, group in groupby(due, lambda one: id(program.lives.at(_lifetime(one[1])))):
        same = list(group)
        # Always as many episodes: another number would be compiled again.
        states = [start_states(k) for k, _ in same]
        states += states[-1:] * (together - len(same))
        evaluation = program.evaluate(_stacked(program, states), _lifetime(same[0][1]))
        n = evaluation.length.shape[1] // len(states)
        for i, (k, step) in enumerate(same):
            on_evaluation(k, step, Evaluation(*(x[:, i * n : (i + 1) * n] for x in evaluation)))


def _end_visits(
    program: Program,
    visits: Sequence[tuple[int, int]],
    after: int,
    on_visit: _OnVisit | None,
) -> None:
    for visit, end in visits:
        if on_visit is not None and after < end <= program.steps:
            if end == program.steps:
                program.finish()
            on_visit(visit, [program.weights(run) for run in range(len(program.specs))])


def _lifetime(step: int) -> int:
    """The lifetime at which a step was taken; of step 0, the one at which the first will be."""
    return max(step - 1, 0)


def _most_at_once(due: Sequence[int], rollout: int) -> int:
    """The greatest number of evaluations with the same weights, at least 1."""
    return max(Counter(-(-step // rollout) for step in due).values(), default=1)


def _stacked(program: Program, groups: Sequence[Sequence[Array]]) -> Array:
    """Initial states of all runs `[runs, episodes, S]`; copies have the first run's."""
    states = [np.concatenate(of_run) for of_run in zip(*groups, strict=True)]
    return np.stack(states + states[:1] * (program.runs - len(states)))


def _algorithm(uses: str) -> tuple[Any, type[Program]]:
    name = uses.removeprefix("jax:").upper()
    return ALGORITHMS[choice("uses", name, ALGORITHMS, error=UnknownNameError)]
