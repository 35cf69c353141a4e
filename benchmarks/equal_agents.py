"""Whether agents in JAX learn as those of Stable-Baselines3 do: regret, paired by instance.

    python -m benchmarks.equal_agents TD3 runs.jsonl --steps 5000 --instances 30 --set r_min=0.5

Instance i is the task of seed i. Each backend trains on each instance; the difference of an
instance is JAX's mean regret minus SB3's, and the interval is Student's over instances. Finished
runs are appended to the file at once, so that the command can be stopped and repeated. A file may
hold runs of several algorithms and settings.

Online regret is the mean over all steps, final regret that over the last tenth, both of the agent
as it explores.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from sme_registry.spec import SMESpec
from sme_registry.training.algorithms import find
from sme_registry.training.learn import Run, Steps, Watch

PARTS = 10  # of a run, each with its own mean regret
MARGIN = {"PPO": 0.01, "TD3": 0.03, "SAC": 0.03}
CONFIDENCE = 0.9


def train_sb3(algorithm: str, spec: SMESpec, seed: int, steps: int) -> list[float]:
    """The regret of each part of a run of Stable-Baselines3 with its defaults."""
    regret: list[float] = []

    class Listener(Watch):
        def on_steps(self, taken: Steps) -> None:
            regret.extend(taken.info["regret"])

    entry = find(algorithm)
    with entry.surroundings():
        run = Run(document=spec, seed=seed, steps=steps, hyperparameters={})
        entry.learner(run).learn(Listener())
    return parts(regret)


def train_jax(
    algorithm: str, specs: Sequence[SMESpec], seeds: Sequence[int], steps: int
) -> list[list[float]]:
    """The same of one lane for each spec."""
    from sme_registry.jax.run import new_program, run

    logs: list[Any] = []
    program = new_program(f"jax:{algorithm}", specs, seeds, steps=steps)
    run(program, on_log=lambda log: logs.append(log.regret))
    return [parts(lane) for lane in np.concatenate(logs).T]


def parts(regret: Any) -> list[float]:
    """Means over equal parts of a run."""
    return [float(part.mean()) for part in np.array_split(regret, PARTS)]


def missing(
    options: argparse.Namespace, done: set[tuple[Any, ...]]
) -> Iterator[tuple[str, list[tuple[int, int]]]]:
    """Runs to do, (instance, repetition), for a program's lanes; the backends take turns."""
    turns = range(0, options.instances, options.lanes)
    for begin in turns:
        instances = range(begin, min(begin + options.lanes, options.instances))
        for backend, repetitions in (("sb3", options.sb3_runs), ("jax", options.jax_runs)):
            for repetition in range(repetitions):
                runs = [(i, repetition) for i in instances if (backend, i, repetition) not in done]
                if runs:
                    yield backend, runs


def report(rows: Sequence[dict[str, Any]], margin: float) -> None:
    """Print the mean of each backend, and their difference with its interval."""
    for name, value in (("online", np.mean), ("final", lambda regret: regret[-1])):
        means: dict[str, dict[int, list[float]]] = {
            "sb3": defaultdict(list),
            "jax": defaultdict(list),
        }
        for row in rows:
            means[row["backend"]][row["instance"]].append(float(value(row["regret"])))
        both = sorted(means["sb3"].keys() & means["jax"].keys())
        if len(both) < 2:
            continue
        sb3, jax = (np.array([np.mean(means[b][i]) for i in both]) for b in ("sb3", "jax"))
        difference = jax - sb3
        half = stats.sem(difference) * stats.t.ppf((1 + CONFIDENCE) / 2, len(both) - 1)
        low, high = difference.mean() - half, difference.mean() + half
        verdict = "inside" if -margin < low and high < margin else "not inside"
        print(
            f"{name:>6} regret, {len(both)} instances: "
            f"SB3 {sb3.mean():.4f} (SD {sb3.std(ddof=1):.4f}), "
            f"JAX {jax.mean():.4f} (SD {jax.std(ddof=1):.4f}), difference {difference.mean():+.4f} "
            f"[{low:+.4f}, {high:+.4f}], {verdict} ±{margin}"
        )


def main() -> None:
    """Run what is missing, then report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("algorithm", choices=MARGIN)
    parser.add_argument("file", type=Path)
    parser.add_argument("--steps", type=int, default=5_000)
    parser.add_argument("--instances", type=int, default=30)
    parser.add_argument("--sb3-runs", type=int, default=1, help="of each instance")
    parser.add_argument("--jax-runs", type=int, default=1, help="of each instance")
    parser.add_argument("--lanes", type=int, default=5, help="instances of a program")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE")
    options = parser.parse_args()
    fields = {
        name: json.loads(value) for name, _, value in (each.partition("=") for each in options.set)
    }
    common = {"algorithm": options.algorithm, "steps": options.steps, "fields": fields}

    def rows() -> list[dict[str, Any]]:
        lines = options.file.read_text().splitlines() if options.file.exists() else []
        return [row for row in map(json.loads, lines) if common.items() <= row.items()]

    done = {(row["backend"], row["instance"], row["repetition"]) for row in rows()}
    for backend, runs in missing(options, done):
        specs = [SMESpec(seed=instance, **fields) for instance, _ in runs]
        seeds = [instance + 1_000 * repetition for instance, repetition in runs]
        if backend == "jax":
            regrets = iter(train_jax(options.algorithm, specs, seeds, options.steps))
        else:
            regrets = (
                train_sb3(options.algorithm, spec, seed, options.steps)
                for spec, seed in zip(specs, seeds, strict=True)
            )
        for (instance, repetition), regret in zip(runs, regrets, strict=True):
            run = {"backend": backend, "instance": instance, "repetition": repetition}
            with options.file.open("a") as file:
                file.write(json.dumps({**common, **run, "regret": regret}) + "\n")
        report(rows(), MARGIN[options.algorithm])


if __name__ == "__main__":
    main()
