"""Generate the pages of `docs/` that list what the code and `specs/` contain: `make docs`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from leaderboard.documents.board import BoardDocument, Limits
from leaderboard.documents.result import ClassScore, Result, RunScore, Scores
from leaderboard.documents.submission import Artefact, Method, Run, Submission, Submitter, Training
from leaderboard.errors import CODES
from leaderboard.seasons.season import Entry, Season, SeasonClass, TicketRequest
from sme_registry.datasets import DatasetRecipe
from sme_registry.datasets.documents import Behaviour
from sme_registry.evaluation import EvaluationReport
from sme_registry.io import write_atomically
from sme_registry.io.markup import fixed
from sme_registry.profiles.document import AXES, Profile
from sme_registry.spec import (
    AgentSpec,
    Drift,
    EnvFile,
    EvaluationProtocol,
    ObservationSpec,
    Phase,
    ProtocolFile,
    SafetySpec,
    SMESpec,
    StreamClass,
    StreamFile,
    StreamSpec,
    StudyAlgorithm,
    StudyFile,
    StudyPlan,
    Suite,
    SuiteClass,
    SuiteFile,
    TeamSpec,
)
from sme_registry.spec.cards import symbol
from sme_registry.spec.catalogue import entries
from sme_registry.spec.document import WORDED, StrictModel, short_repr, summary

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER)]

from _gallery import READING, anchor, draw, gallery, group_of  # noqa: E402
from _gallery.entries import entries as files  # noqa: E402

_FIELDS = ("state_dim", "action_dim", "k", "r_min", "D", "complexity", "hidden_width")
_SYMBOLS = tuple(map(symbol, _FIELDS))
_DOCUMENTS: dict[str, tuple[type[StrictModel], ...]] = {
    "Tasks": (SMESpec, TeamSpec, AgentSpec, SafetySpec, ObservationSpec),
    "Streams": (StreamSpec, Phase, Drift),
    "Suites": (Suite, SuiteClass, StreamClass),
    "Evaluation protocols": (EvaluationProtocol,),
    "Study plans": (StudyPlan, StudyAlgorithm),
    "Data sets": (DatasetRecipe, Behaviour),
    "Files": (EnvFile,),
    "Boards": (BoardDocument, Limits),
    "Submissions": (Submission, Method, Submitter, Run, Artefact, Training),
    "Results": (Result, Scores, ClassScore, RunScore),
    "Seasons": (Season, SeasonClass, Entry, TicketRequest),
}
_SCHEMAS: tuple[type[BaseModel], ...] = (
    *(SMESpec, StreamSpec, Suite, EvaluationProtocol, StudyPlan),
    *(EnvFile, StreamFile, SuiteFile, ProtocolFile, StudyFile),
    *(DatasetRecipe, EvaluationReport),
    *(BoardDocument, Submission, Result, Season, Entry, TicketRequest),
)


def catalogue() -> str:
    """The page of the catalogue, from its files."""
    groups = dict.fromkeys(map(group_of, files().values()))
    lines = [
        "# The catalogue",
        "",
        "Every environment, stream, suite and protocol of the package. The pages below have a card",
        "for each environment and stream: what it asks of an agent, a picture of its optimal",
        "policy, and numbers to compare your own with.",
        "",
        READING,
        *(f"- [{group.title}](catalogue-{group.slug}.md)" for group in groups),
        "",
        "```{toctree}",
        ":hidden:",
        "",
        *(f"catalogue-{group.slug}" for group in groups),
        "```",
        "",
        "## Environments",
        "",
        "Each id of a single agent (agents = 1) also exists with `Symmetric` before the version,",
        "such as `SME/DefaultSymmetric-v1`: the same task, with actions in [−1, 1], not [0, 1].",
        "",
        f"| Id | {' | '.join(_SYMBOLS)} | agents |",
        "|---" * (len(_SYMBOLS) + 2) + "|",
    ]
    for env in entries(EnvFile):
        values = " | ".join(f"{getattr(env.spec, field):g}" for field in _FIELDS)
        agents = len(env.spec.team.agents) if env.spec.team else 1
        page = f"catalogue-{group_of(env).slug}.md#{anchor(env.name)}"
        lines.append(f"| [`SME/{env.versioned_name}`]({page}) | {values} | {agents} |")
    lines += ["", "## Suites", "", "| Name | classes | instances | digest | |", "|---" * 5 + "|"]
    for suite in entries(SuiteFile):
        counts = f"{len(suite.suite.runs)} | {sum(suite.suite.runs.values())}"
        lines.append(
            f"| `{suite.versioned_name}` | {counts} | `{_short(suite.digest)}` "
            f"| {suite.description} |"
        )
    lines += ["", "## Protocols", "", "| Name | states a region | digest | |", "|---" * 4 + "|"]
    for protocol in entries(ProtocolFile):
        lines.append(
            f"| `{protocol.versioned_name}` | {protocol.protocol.states_per_region:,} "
            f"| `{_short(protocol.digest)}` | {protocol.description} |"
        )
    return "\n".join(lines) + "\n"


_PROFILES = """\
# Reference profiles

What PPO and others do on the default and on two harder levels of nine axes, with 20,000 steps and
five draws of each level. `sme profile` shows your own algorithm beside them, and
`sme profile show PPO` one of them. Agents are in JAX, with the default hyperparameters of
Stable-Baselines3; γ = 0 is mostly their strongest setting where nothing but the present step
matters, and their weakest on reward intervals and foresight. `linear` is the linear policy nearest
to the optimum, and does not learn; a random policy has N₀ of about 1.3 at each level, 1.55 at
A = 16.
PPO trains in whole rollouts, so for 20,480 steps.

![PPO and other references over the levels of nine axes](../../figures/profiles.png)

## N₀ at each level

Normalised regret in the training cube: 0 is the optimum, 1 the constant action ½. IQM over draws.
The first level of foresight and noise is a task of two layers, and layers are `unit_variance`.
"""
_ROBUSTNESS = """
## Robustness

The mean over the harder levels of 1 − N₀ there, divided by 1 − N₀ at the first level, with its
95 % interval over draws; below 0 it is worse than the constant ½. A dash: nothing was learnt, or a
level was not run.
"""
_ORIGIN = """
## Origin

Made by `docs/results/profiles.py`, from the plan `profile-v1` (`{digest}`).

| Profile | `uses` | runs | versions |
|---|---|---|---|"""


def profiles() -> str:
    """The page of the reference profiles, from the data that the package has."""
    references = Profile.references()
    heading = f"| axis | levels | {' | '.join(references)} |"
    rule = "|---" * (len(references) + 2) + "|"
    regret, robustness = [heading, rule], [heading, rule]
    for axis in AXES:
        place = f"| {axis.label} | {', '.join(axis.levels.values())} | "
        texts = []
        for each in references.values():
            levels = map(each.level, axis.levels)
            texts.append(", ".join(fixed(x.value) if x.draws else "–" for x in levels))
        regret.append(f"{place}{' | '.join(texts)} |")
        kept = [str(each.robustness(axis)) for each in references.values()]
        robustness.append(f"{place}{' | '.join(kept)} |")
    origin = _ORIGIN.format(digest=_short(references["PPO"].plan_digest))
    lines = [_PROFILES, *regret, _ROBUSTNESS, *robustness, origin]
    for name, each in references.items():
        versions = ", ".join(f"{package} {v}" for package, v in sorted(each.versions.items()))
        runs = f"{len(each.rows)} of {each.planned}"
        lines.append(f"| {name} | `{each.algorithm.uses}` | {runs} | {versions} |")
    return "\n".join(lines) + "\n"


def leaderboard_codes() -> str:
    """The table of the leaderboard's error codes, which the page of its command includes."""
    lines = [
        "The leaderboard rejects with these codes: on the command line (exit code 1), over HTTP",
        "(`code`), and in a rejected result. Their meaning never changes.",
        "",
        "| Code | |",
        "|---|---|",
        *(f"| `{code}` | {meaning} |" for code, meaning in CODES.items()),
    ]
    return "\n".join(lines) + "\n"


def documents() -> str:
    """The page of the documents' fields, from their classes."""
    lines = [
        "# Files",
        "",
        "The fields of every document. `help(SMESpec)` shows the same texts. A field without a",
        "default is required. `null` is `None` in Python, and a class means an object with its",
        "fields. A program in any language can check a document by its JSON Schema, which",
        "`sme show --json-schema` prints:",
        "",
        "```{json-schemas}",
        *(f"{kind.__module__}.{kind.__name__}" for kind in _SCHEMAS),
        "```",
    ]
    for title, kinds in _DOCUMENTS.items():
        lines += ["", f"## {title}"]
        for kind in kinds:
            lines += ["", f"### `{kind.__name__}`", "", summary(kind), ""]
            lines += ["| Field | Allowed | Default | Meaning |", "|---" * 4 + "|"]
            lines += [
                "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
                for cells in _rows(kind)
            ]
    return "\n".join(lines) + "\n"


def _rows(kind: type[StrictModel]) -> list[tuple[str, ...]]:
    root = kind.model_json_schema()
    fields = (root["$defs"][kind.__name__] if "$ref" in root else root)["properties"]
    return [
        (f"`{name}`", _allowed(fields[name]), _default(field), field.description or "")
        for name, field in kind.model_fields.items()
    ]


def _default(field: FieldInfo) -> str:
    """A field's default as in JSON; empty where the field is required."""
    if field.is_required():
        return ""
    default = field.get_default(call_default_factory=True, validated_data={})
    if default is None:
        return "null"
    if isinstance(default, BaseModel):
        return f"{type(default).__name__}()"
    return short_repr(list(default) if isinstance(default, tuple) else default)


def _allowed(schema: dict[str, Any]) -> str:
    """What a JSON Schema allows, in words: `an integer in [1, 4096]`."""
    if "anyOf" in schema:
        return " or ".join(map(_allowed, schema["anyOf"]))
    if "$ref" in schema:
        return f"`{schema['$ref'].rpartition('/')[2]}`"
    if "const" in schema or "enum" in schema:
        return " or ".join(repr(value) for value in schema.get("enum", [schema.get("const")]))
    match schema.get("type"):
        case "integer":
            return "an integer" + _interval(schema)
        case "number":
            return "a finite number" + _interval(schema)
        case "string":
            return str(schema.get(WORDED, "a string" + _length(schema, "Length", "characters")))
        case "array":
            return "a list" + _length(schema, "Items", "entries")
        case "object":
            return "an object: names with values"
        case "boolean":
            return "true or false"
    return str(schema.get("type", "of another form"))


def _interval(schema: dict[str, Any]) -> str:
    low = f"[{schema['minimum']}" if "minimum" in schema else "(−∞"
    high = f"{schema['maximum']}]" if "maximum" in schema else "∞)"
    low = f"({schema['exclusiveMinimum']}" if "exclusiveMinimum" in schema else low
    high = f"{schema['exclusiveMaximum']})" if "exclusiveMaximum" in schema else high
    return "" if (low, high) == ("(−∞", "∞)") else f" in {low}, {high}"


def _length(schema: dict[str, Any], of: str, unit: str) -> str:
    shortest, longest = schema.get(f"min{of}", 0), schema.get(f"max{of}")
    return "" if longest is None else f" of {shortest} to {longest} {unit}"


def _short(digest: str) -> str:
    return digest[: len("sha256:") + 12]


GENERATED = FOLDER / "reference" / "generated"


def pages() -> dict[str, str]:
    """Every generated page, by its name in `docs/reference/generated/`."""
    cards = {f"catalogue-{group.slug}": page for group, page in gallery().items()}
    others = {"catalogue": catalogue(), "files": documents(), "codes": leaderboard_codes()}
    others["profiles"] = profiles()
    return {f"{name}.md": text for name, text in (others | cards).items()}


if __name__ == "__main__":
    draw(FOLDER / "reference" / "gallery")
    for name, text in pages().items():
        print(f"wrote {write_atomically(GENERATED / name, text)}")
