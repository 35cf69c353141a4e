"""A program from a name and hyperparameters, and its run: advance, evaluate where due, finish.

program = new_program("jax:PPO", specs, seeds, hyperparameters={"n_steps": 512}, steps=100_000)
run(program, due=[50_000, 100_000], start_states=..., on_log=..., on_evaluation=...)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby, islice
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.io import choice, integer_in
from sme_registry.jax.lives import Lane
from sme_registry.jax.ppo import PPO, PPOProgram
from sme_registry.jax.program import (
    PIECE,
    Array,
    Evaluation,
    Program,
    StepLog,
    hidden_layers,
    policy,
)
from sme_registry.jax.sac import SAC, SACProgram
from sme_registry.jax.task import Shape
from sme_registry.jax.td3 import TD3, TD3Program
from sme_registry.spec import ACTION_RANGES
from sme_registry.spec.study import JAX

ALGORITHMS: dict[str, tuple[Any, type[Program]]] = {
    "PPO": (PPO, PPOProgram),
    "TD3": (TD3, TD3Program),
    "SAC": (SAC, SACProgram),
}
"""Hyperparameters and program of each algorithm."""

_OnVisit = Callable[[int, list[dict[str, Array]]], Any]

POLICY = "policy_kwargs"
_OF_POLICY = ("net_arch",)  # hyperparameters that Stable-Baselines3 has in `policy_kwargs`


def full_name(uses: str, field: str = "uses") -> str:
    """The exact name, `jax:PPO`, of an algorithm in any case."""
    name = uses.removeprefix(JAX)
    for known in ALGORITHMS:
        if known.casefold() == name.casefold():
            return JAX + known
    names = [JAX + known for known in ALGORITHMS]
    raise UnknownNameError(
        f"{field}={uses!r}: must be one of {', '.join(names)}. Other algorithms run without JAX."
        f"{did_you_mean(uses, names)}"
    )


def settings_of(
    uses: str,
    hyperparameters: Mapping[str, Any],
    field: str = "hyperparameters",
) -> Any:
    """The hyperparameters of an algorithm, with its defaults for those that are left out.

    JSON values by the names of Stable-Baselines3; `net_arch` is in `policy_kwargs`. Error messages
    call them `field`.
    """
    kind, _ = _algorithm(uses)
    name = full_name(uses)
    fields = {each.name for each in dataclasses.fields(kind)}
    known = {f"{POLICY}.{name}" if name in _OF_POLICY else name: name for name in sorted(fields)}
    values = {}
    for given, value in _flat(hyperparameters, field).items():
        if given not in known:
            raise OptionError(
                f"{field}.{given}: {name} has no such hyperparameter."
                f"{did_you_mean(given, known)} Known: {', '.join(known)}. For "
                "others, use the algorithm of Stable-Baselines3."
            )
        values[known[given]] = value
    try:
        return TypeAdapter(kind).validate_python(values)
    except ValidationError as error:
        fault = error.errors()[-1]  # of a text or a number: that of the number
        own_error = fault.get("ctx", {}).get("error")
        if isinstance(own_error, OptionError):  # of values that do not go together
            raise own_error from None
        place = ".".join(str(part) for part in fault["loc"][:1])
        shown = next((shown for shown, own in known.items() if own == place), place)
        raise OptionError(
            f"{field}.{shown}={values.get(place, values)!r:.60}: {fault['msg']}. Correct it, or "
            "leave it out for the default."
        ) from None


def new_program(
    uses: str,
    specs: Sequence[Lane],
    seeds: Sequence[int],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    action_range: str = "symmetric",
    steps: int,
    lanes: int | None = None,
    shape: Shape | None = None,
    device: str | None = None,
    at_once: int = 1,
) -> Program:
    """A program of new lanes, `jax:PPO`, `jax:TD3` or `jax:SAC`.

    Args:
      uses: the algorithm.
      specs: the task or the stream of each lane; streams that switch at the same steps.
      seeds: of each lane, in [0, 2**32): of its weights, its starts and its noise.
      hyperparameters: see `settings_of`.
      action_range: of the policies' actions, "symmetric" or "unit".
      steps: that each lane is to take.
      lanes: fill up to this number with copies of the first lane; None for none.
      shape: to which the tasks are padded; None for their maxima.
      device: "cpu", "gpu" or "tpu"; None for JAX's default.
      at_once: programs that are to share what the device has of memory.
    """
    integer_in("len(specs)", len(specs), 1)
    integer_in("len(seeds)", len(seeds), len(specs), len(specs), advice="Give a seed of each task.")
    for i, seed in enumerate(seeds):
        integer_in(f"seeds[{i}]", seed, 0, 2**32 - 1)
    integer_in("steps", steps, 0)
    if lanes is not None:
        integer_in("lanes", lanes, len(specs), advice="Leave it out for one of each task.")
    choice("action_range", action_range, ACTION_RANGES)
    _, program = _algorithm(uses)
    return program(
        settings_of(uses, hyperparameters or {}),
        specs,
        seeds,
        steps=steps,
        action_range=action_range,
        lanes=lanes,
        shape=shape,
        device=device,
        at_once=at_once,
    )


def policy_of(
    uses: str,
    weights: Mapping[str, Array],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    action_range: str = "symmetric",
) -> Callable[[Array], Array]:
    """The deterministic policy of weights, from observations `[B, O]` to actions `[B, A]`."""
    choice("action_range", action_range, ACTION_RANGES)
    _, program = _algorithm(uses)
    settings = settings_of(uses, hyperparameters or {})
    return policy(program, settings, weights, action_range == "symmetric")


def hidden_of(
    uses: str, weights: Mapping[str, Array], hyperparameters: Mapping[str, Any]
) -> Callable[[Array], list[Array]]:
    """The hidden layers of that policy; see `program.hidden_layers` and `settings_of`."""
    _, program = _algorithm(uses)
    return hidden_layers(program, settings_of(uses, hyperparameters), weights)


def run(
    program: Program,
    *,
    due: Sequence[int] = (),
    start_states: Callable[[int], Sequence[Array]] | None = None,
    on_log: Callable[[StepLog], Any],
    on_evaluation: Callable[[int, int, Evaluation], Any] | None = None,
    on_visit: _OnVisit | None = None,
    after_piece: Callable[[], Any] = lambda: None,
    piece: int = PIECE,
) -> None:
    """Run a program to its end, from its start or from where it was restored.

    Evaluations are those of a study's cell: the k-th one has the weights of step `due[k]`, before
    an update that follows it; the last one waits for the end and the last update. Those whose
    weights are the same, as in PPO's rollouts, run together. In a stream they are of the task on
    which that step was taken.

    The policy at the end of a visit of a stream's phase has learned from all that it collected in
    it: with TD3 and SAC up to the update that follows the last step, with PPO up to that of the
    last rollout that was over by then. The last visit ends with the training: PPO finishes its last
    rollout in it.

    Args:
      program: whose state is saved only in `after_piece`, or before.
      due: steps of the evaluations, increasing.
      start_states: the initial states of the k-th evaluation, `[episodes, S]` of each lane that is
        no copy; equally many in all lanes.
      on_log: called with the steps after each piece.
      on_evaluation: called with k, the step, and the evaluation of all lanes.
      on_visit: called with the index of a visit and the weights of each lane that is no copy, at
        the end of each visit of a phase; after the evaluations that are due there.
      after_piece: called after each piece and its evaluations, when the state may be saved.
      piece: most steps between two calls; on-policy programs finish their rollout.
    """
    steps = list(due[:-1])
    together = _most_at_once(steps, program.rollout)

    def evaluate(due: Sequence[tuple[int, int]]) -> None:
        if start_states is not None and on_evaluation is not None:
            for k, step, done in _evaluated(program, due, start_states, together):
                on_evaluation(k, step, done)

    def evaluate_due(after: int) -> None:
        evaluate([(k, step) for k, step in enumerate(steps) if after < step <= program.steps])

    if program.steps == 0:
        evaluate_due(after=-1)
    while program.steps < program.budget:
        before = program.steps
        visits = program.lives.visit_ends(before) if on_visit is not None else iter(())
        ends = [end for _, end in islice(visits, 1)]
        upcoming = [step for step in steps if step > before]
        on_log(program.advance(min([before + piece, program.budget, *upcoming[:1], *ends])))
        evaluate_due(after=before)
        if on_visit is not None:
            _end_visits(program, before, on_visit)
        after_piece()
    if program.budget:
        program.finish()
    if on_visit is not None:
        _end_last_visit(program, on_visit)
    evaluate([(k, program.steps) for k in range(len(steps), len(due))])


def _evaluated(
    program: Program,
    due: Sequence[tuple[int, int]],
    start_states: Callable[[int], Sequence[Array]],
    together: int,
) -> Iterator[tuple[int, int, Evaluation]]:
    """The evaluations of these indices and steps with the present weights, tasks by tasks."""
    for _, group in groupby(due, lambda one: id(program.lives.at(_lifetime(one[1])))):
        same = list(group)
        # Always as many episodes: another number would be compiled again.
        states = [start_states(k) for k, _ in same]
        states += states[-1:] * (together - len(same))
        done = program.evaluate(_stacked(program, states), _lifetime(same[0][1]))
        n = done.length.shape[1] // len(states)
        for i, (k, step) in enumerate(same):
            yield k, step, Evaluation(*(x[:, i * n : (i + 1) * n] for x in done))


def _end_visits(program: Program, after: int, on_visit: _OnVisit) -> None:
    """End the visits, but the last one, whose last step is later than `after`, and done."""
    for visit, end in program.lives.visit_ends(after):
        if end > program.steps or (visit, end) == program.lives.last_visit:
            return
        if end == program.steps:
            program.finish()
        on_visit(visit, _weights(program))


def _end_last_visit(program: Program, on_visit: _OnVisit) -> None:
    """End the last visit, if the training that is over has reached its end."""
    last = program.lives.last_visit
    if last is not None and last[1] <= program.steps:
        on_visit(last[0], _weights(program))


def _weights(program: Program) -> list[dict[str, Array]]:
    """Of each lane that is no copy."""
    return [program.weights(lane) for lane in range(len(program.specs))]


def _lifetime(step: int) -> int:
    """The lifetime at which a step was taken; of step 0, the one at which the first will be."""
    return max(step - 1, 0)


def _most_at_once(due: Sequence[int], rollout: int) -> int:
    """The greatest number of evaluations with the same weights, at least 1."""
    return int(
        max(np.unique([-(-step // rollout) for step in due], return_counts=True)[1], default=1)
    )


def _stacked(program: Program, groups: Sequence[Sequence[Array]]) -> Array:
    """Initial states of all lanes `[lanes, episodes, S]`, padded; copies have the first lane's."""
    S = program.params.W.shape[-1]
    own = [np.concatenate(lane) for lane in zip(*groups, strict=True)]
    lanes = own + own[:1] * (program.lanes - len(own))
    return np.stack([np.pad(states, [(0, 0), (0, S - states.shape[1])]) for states in lanes])


def _algorithm(uses: str) -> tuple[Any, type[Program]]:
    return ALGORITHMS[full_name(uses).removeprefix(JAX)]


def _flat(hyperparameters: Mapping[str, Any], field: str) -> dict[str, Any]:
    """Those of the policy by dotted names."""
    flat: dict[str, Any] = {}
    for name, value in hyperparameters.items():
        if name.startswith(f"{POLICY}."):
            # Stable-Baselines3, which keeps the model, has no such name.
            raise OptionError(
                f"{field}.{name}: must be in the dict {POLICY}, such as "
                f'{{"{POLICY}": {{"net_arch": [64, 64]}}}}.'
            )
        if name == POLICY and isinstance(value, Mapping):
            flat |= {f"{POLICY}.{each}": given for each, given in value.items()}
        else:
            flat[name] = value
    return flat
