"""The page: one HTML file that carries its data and its script, and loads nothing.

The networks of the task and of a policy are in the data as programs. A policy whose network is
unknown is sampled instead, on a grid over two of the inputs.

Text from outside is only ever in the data, which is JSON in which `<`, `>` and `&` are escaped; the
script puts it on the page as text. A content security policy allows this script and this style by
their hashes, and nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from sme_registry.diagnosis.behaviour import Log, rollout
from sme_registry.diagnosis.measure import MAX_NUMBERS, fit_references
from sme_registry.diagnosis.subject import AnySubject, StreamSubject, Subject
from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.evaluation import EvaluationReport, Policy
from sme_registry.evaluation.policies import TeamPolicy
from sme_registry.evaluation.references import LABELS, References
from sme_registry.explorer import program as programs
from sme_registry.explorer.policies import policy_program
from sme_registry.explorer.program import MAX_WEIGHTS, encoded
from sme_registry.io import write_atomically
from sme_registry.io.markup import environment
from sme_registry.spec import SMESpec, catalogue
from sme_registry.statistics import smoothed
from sme_registry.task import Task, draw, materialize
from sme_registry.task.draw import Array
from sme_registry.task.loading import parameter_bytes
from sme_registry.training.algorithms import short_name
from sme_registry.training.run import EVALUATION, EXPLORER
from sme_registry.version import __version__

FILE = EXPLORER
EPISODES = 64
MAX_INPUTS = 512  # each has a slider
_GRID = 81  # points along a side of a sampled map
_EPSILON = 1.0  # of a sampled map: [−½, 1½]²
_FIT_STATES = 2048
_MAX_HORIZON = 20_000  # longer episodes are not run
_TIMES, _LINE, _DOTS = 200, 300, 500  # points of a drawn line, and dots of a training
_LINEAR, _HALF = "linear", "constant"
_ASSETS = Path(__file__).parent / "assets"
_ESCAPES = str.maketrans({letter: f"\\u{ord(letter):04x}" for letter in "<>&\u2028\u2029"})


def write_explorer(
    path: str | os.PathLike[str],
    subject: SMESpec | AnySubject,
    *,
    report: EvaluationReport | None = None,
    channels: Sequence[tuple[int, int]] = (),
    episodes: int = EPISODES,
    seed: int = 0,
) -> Path:
    """Write the page of a task, or of a policy on its task, completely or not at all.

    `channels` are pairs of inputs, from 1 (state channels, then distractors), over which a policy
    whose network is unknown is sampled; an OptionError where there is no such policy.
    """
    if Path(path).suffix != ".html":
        raise OptionError(f"{os.fspath(path)}: must end in .html.")
    data = facts(subject, report=report, channels=channels, episodes=episodes, seed=seed)
    return write_atomically(path, explorer_page(data))


def explorer_page(data: dict[str, Any], static: str = "") -> str:
    """The page of some `facts`, as HTML.

    `static` is the address of a folder with the files of `STATIC`, relative to the page, for a site
    that forbids inline code; a page without it needs no other file.
    """
    script, style = STATIC["explorer.js"], STATIC["explorer.css"]
    sources = ("'self' file:",) * 2 if static else tuple(f"'{_hash(x)}'" for x in (script, style))
    return (
        environment(_ASSETS, autoescape=True)
        .get_template("page.html.jinja")
        .render(
            title=f"{data['name']} on {data['title']}" if data["name"] else data["title"],
            kind="Policy and task" if data["name"] else "Task",
            version=__version__,
            data=Markup(json_in_html(data)),
            static=static,
            script=Markup(script),
            script_source=Markup(sources[0]),
            style=Markup(style),
            style_source=Markup(sources[1]),
        )
    )


def run_report(folder: str | os.PathLike[str]) -> EvaluationReport | None:
    """The evaluation in a run's folder; None if there is none."""
    path = Path(folder) / EVALUATION
    return EvaluationReport.read(path) if path.exists() else None


def json_in_html(data: Any) -> str:
    """Data as JSON that no text in it can end, inside a `<script>` element."""
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.translate(_ESCAPES)


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


STATIC = {
    # One strict function, so that the files share names and add none to the page but `explorer`.
    "explorer.js": '(function () {\n"use strict";\n'
    + "\n".join(map(_asset, ("equations.js", "charts.js", "explorer.js")))
    + "})();\n",
    "explorer.css": _asset("explorer.css"),
}
"""The script and the style of every page, by name."""


def facts(
    subject: SMESpec | AnySubject,
    *,
    report: EvaluationReport | None = None,
    channels: Sequence[tuple[int, int]] = (),
    episodes: int = EPISODES,
    seed: int = 0,
    remark: str = "",
) -> dict[str, Any]:
    """The data of a page; the arguments are those of `write_explorer`, and a text above the map."""
    if isinstance(subject, StreamSubject):
        raise OptionError(
            f"run={subject.name!r}: is a life in a stream, and an explorer shows one policy on one "
            "task. Give the model of one visit, such as RUN/snapshots/visit-00.zip, with --task "
            "FILE, the task of its phase."
        )
    spec, run = (subject, None) if isinstance(subject, SMESpec) else (subject.spec, subject)
    check_size(spec)
    pairs = [_pair(pair, programs.point_width(spec)) for pair in channels]
    task = materialize(spec)
    optimal, limit = programs.optimal(task), programs.limit(task)
    fitted = fit_references(task, _FIT_STATES, seed)
    references = {
        _LINEAR: programs.linear(task, fitted),
        _HALF: programs.constant(task, np.full(spec.action_dim, 0.5)),
    }
    policies = [
        {"name": LABELS[name], "of": "point", "program": program.to_dict()}
        for name, program in references.items()
    ]
    name = None
    if run is not None:
        name = _name(run)
        policies.insert(0, {"name": name, **_policy(run, task, pairs or [(0, 1)])})
    if pairs and policies[0]["of"] != "grid":
        raise OptionError(
            "--channels: are of a policy whose network is unknown; this map shows any two channels."
        )
    probes = () if report is None or report.observation is None else report.observation.probes
    return {
        "title": catalogue.title(spec),
        "name": name,
        "digest": spec.digest,
        "task": _task(task),
        "optimal": optimal.to_dict(),
        "limit": None if limit is None else limit.to_dict(),
        "observe": programs.observe(task).to_dict(),
        "policies": policies,
        "rest": _rounded(resting(spec)),
        "start": _rounded(_start(spec)),
        "episode": _episode(task, run, fitted, episodes, seed),
        "training": _training(None if run is None else run.log),
        "regions": None if report is None else _regions(report),
        "probes": [probe.model_dump() for probe in probes],
        "remark": remark,
        "plan": {} if run is None else _plan(run),
    }


def check_size(spec: SMESpec) -> None:
    """Raise OptionError or ResourceLimitError if a task is too large for a page."""
    inputs = programs.point_width(spec)
    if inputs > MAX_INPUTS:
        raise OptionError(
            f"state_dim={spec.state_dim}: with {inputs} inputs, and a page has a slider for each: "
            f"must be at most {MAX_INPUTS}. Use `sme evaluate` or `sme diagnose`."
        )
    weights = parameter_bytes(spec) // 8
    if weights > MAX_WEIGHTS:
        raise ResourceLimitError(
            f"complexity={spec.complexity}, hidden_width={spec.hidden_width}, "
            f"state_dim={spec.state_dim}: a task of {weights:,} numbers is too large for a page: "
            f"must be at most {MAX_WEIGHTS:,}. Use `sme evaluate` or `sme diagnose`."
        )


def _name(subject: Subject) -> str:
    """What the page calls a policy: the algorithm of a run, which is known by its folder."""
    algorithm = subject.plan.get("algorithm")
    return subject.name if algorithm is None else short_name(str(algorithm))


def resting(spec: SMESpec) -> Array:
    """Where inputs that are not shown are: the cube's centre, t = T/2, r_cum = 0."""
    return np.array([*[0.5] * (spec.state_dim + spec.distractors), 0.5, 0.0])


def _start(spec: SMESpec) -> Array:
    """Where a page opens: a random point, since at the centre each optimum is ½."""
    point = draw.uniform(0, "explorer/point", spec.state_dim + spec.distractors)
    return np.array([*point.round(2), 0.5, 0.0])


def _pair(channels: tuple[int, int], inputs: int) -> tuple[int, int]:
    first, second = channels
    if first == second or not all(1 <= channel <= inputs - 2 for channel in channels):
        raise OptionError(
            f"--channels {first},{second}: must be two different channels in [1, {inputs - 2}]. "
            "State channels come first, then distractors."
        )
    return first - 1, second - 1


def _task(task: Task) -> dict[str, Any]:
    spec = task.spec
    return {
        "S": spec.state_dim,
        "A": spec.action_dim,
        "m": spec.distractors,
        "L": spec.complexity,
        "k": spec.k,
        "r_min": spec.r_min,
        "D": spec.D,
        "T": spec.horizon,
        "tau": spec.tightness or None,
        "mixing": spec.mixing,
        "agents": []
        if spec.team is None
        else [
            {"name": name, "from": owned.start + 1, "to": owned.stop}
            for name, owned in zip(task.names, task.owned, strict=True)
        ],
    }


def _policy(subject: Subject, task: Task, pairs: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """The policy as a program of observations, or its actions on a grid."""
    program = policy_program(subject.policy, task.spec)
    if program is not None:
        return {"of": "observation", "program": program.to_dict()}
    recurrent = getattr(subject.policy, "episodes", None) is not None
    grids = [_grid(subject.policy, task, pair) for pair in dict.fromkeys(pairs)]
    return {"of": "grid", "recurrent": recurrent, "grids": grids}


def _grid(policy: Policy | TeamPolicy, task: Task, axes: tuple[int, int]) -> dict[str, Any]:
    """Actions `[_GRID, _GRID, A]` over two inputs; rows by the second."""
    points = np.tile(resting(task.spec), (_GRID * _GRID, 1))
    time = points.shape[1] - 2  # which does not leave the unit range
    beyond = [_EPSILON / 2.0 if axis < time else 0.0 for axis in axes]
    across, up = (np.linspace(-more, 1.0 + more, _GRID) for more in beyond)
    points[:, axes[0]] = np.tile(across, _GRID)
    points[:, axes[1]] = np.repeat(up, _GRID)
    seen = programs.observe(task)(points).astype(np.float32)
    rows = [np.clip(policy(part), 0.0, 1.0) for part in np.array_split(seen, _GRID)]
    actions = np.concatenate(rows).astype(np.float32)
    return {"axes": list(axes), "n": _GRID, "epsilon": _EPSILON, "actions": encoded(actions)}


def _episode(
    task: Task,
    subject: Subject | None,
    fitted: References,
    episodes: int,
    seed: int,
) -> dict[str, Any] | None:
    """The regret of each step of an episode, over some episodes; None if they are too long."""
    S, A, T = task.spec.state_dim, task.spec.action_dim, task.spec.horizon
    if T > _MAX_HORIZON:
        return None
    n = max(1, min(episodes, MAX_NUMBERS // (T * (S + A + 8))))
    starts = draw.uniform(seed, "explorer/starts", n * S).reshape(n, S)

    sizes = [channels.stop - channels.start for channels in task.owned]

    def over_time(act: Callable[[Any, Any], Any]) -> dict[str, Any]:
        runs = rollout(act, task, starts, seed)
        mae = np.average([run.mae for run in runs], axis=0, weights=sizes)
        regret = 1.0 - task.reward_of(1.0 - mae)
        return _over_time(regret, runs[0].alive, T)

    half = np.full((n, A), 0.5)
    lines = {
        LABELS[_LINEAR]: over_time(lambda s, _: fitted.linear(s))["mean"],
        LABELS[_HALF]: over_time(lambda *_: half)["mean"],
    }
    policy = None if subject is None else subject.policy.start()
    own = {} if policy is None else over_time(lambda _, seen: policy(seen))
    return {"episodes": n, "t": _edges(T)[:-1].tolist(), "references": lines, **own}


def _edges(T: int) -> npt.NDArray[np.int64]:
    return np.linspace(0, T, min(T, _TIMES) + 1).round().astype(np.int64)


def _over_time(regret: Array, alive: npt.NDArray[np.bool_], T: int) -> dict[str, Any]:
    """Mean and deciles of `[t, n]` regrets over running episodes, by time; None after the last."""
    rows: list[list[Any]] = []
    for low, high in itertools.pairwise(_edges(T)):
        values = regret[low:high][alive[low:high]]
        running = alive[low:high].mean() if low < len(alive) else 0.0
        numbers: list[Any] = [None] * 3
        if len(values):
            numbers = _rounded([values.mean(), *np.quantile(values, [0.1, 0.9])])
        rows.append([*numbers, round(float(running), 4)])
    columns = zip(("mean", "low", "high", "running"), zip(*rows, strict=True), strict=True)
    return {name: list(column) for name, column in columns}


def _training(log: Log | None) -> dict[str, Any] | None:
    if log is None:
        return None
    x, y, window = smoothed(log.step, log.regret)
    order = np.argsort(log.step, kind="stable")
    dots, line = _thinned(len(order), _DOTS), _thinned(len(x), _LINE)
    return {
        "each": "episode" if log.source == "episodes" else "evaluation",
        "count": len(log.step),
        "window": window,
        "dots": [_rounded(log.step[order][dots]), _rounded(log.regret[order][dots])],
        "line": [_rounded(x[line]), _rounded(y[line])],
    }


def _thinned(count: int, most: int) -> npt.NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def _regions(report: EvaluationReport) -> dict[str, Any]:
    lines = {report.policy: report.regions} | {
        LABELS[name]: report.references[name]
        for name in (_LINEAR, _HALF)
        if name in report.references
    }
    return {
        "names": [region.name for region in report.regions],
        "epsilon": [region.epsilon_high for region in report.regions],
        "lines": {
            name: _rounded([region.normalised_regret for region in regions])
            for name, regions in lines.items()
        },
    }


def _plan(subject: Subject) -> dict[str, str]:
    """What is known about the training, as text."""
    plan: dict[str, Any] = subject.plan
    texts: dict[str, str] = {"run": subject.name} if "algorithm" in plan else {}
    texts |= {name: str(plan[name]) for name in ("algorithm", "steps", "seed") if name in plan}
    if "steps" in texts:
        texts["steps"] = f"{plan['steps']:,}"
    if settings := plan.get("hyperparameters"):
        texts["hyperparameters"] = ", ".join(f"{k} = {v}" for k, v in sorted(settings.items()))
    if subject.checkpoint_step is not None:
        texts["checkpoint"] = f"unfinished, at step {subject.checkpoint_step:,}"
    return texts


def _rounded(values: Any) -> list[float]:
    """Numbers with six digits, which is more than a screen shows."""
    return [float(f"{value:.6g}") for value in np.asarray(values, dtype=np.float64)]
