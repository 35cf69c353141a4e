"""`sweep`: a task's settings along one or several axes, as classes of a plan.

Each axis varies one field of the task and nothing else. A field inside another one has a dotted
name: `team.reward`, `team.agents.0.observes`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from sme_registry.errors import OptionError
from sme_registry.spec.document import short_repr
from sme_registry.spec.sme_spec import Setting, SMESpec
from sme_registry.spec.suite import SuiteClass

_LONGEST_NAME = 64


def sweep(
    spec: SMESpec, axes: Mapping[str, Sequence[Any]], *, name: str = "default", instances: int = 1
) -> tuple[SuiteClass, ...]:
    """The classes of a sweep: named settings that each differ from the task in one field.

    One class for each value of a single axis, such as `k-1`, `k-5`. With several axes, or none, the
    task itself comes first, and stands for its own value on each axis. Each class has `instances`
    draws, with the task's seed and those that follow it.

    Examples:
      >>> from sme_registry.studies import sweep
      >>> [each.name for each in sweep(sme_registry.SMESpec(), {"k": [1, 5, 10]})]
      ['k-1', 'k-5', 'k-10']
    """
    fields = spec.to_dict()
    seeds = instance_seeds(fields.pop("seed"), instances)
    base = Setting.from_dict(fields)
    classes = [SuiteClass(name=name, setting=base, seeds=seeds)] if len(axes) != 1 else []
    for field, values in axes.items():
        _check_axis(field, values)
        settings = [
            Setting.from_dict(_with(fields, field, value), f"sweep {field}={_text(value)}")
            for value in values
        ]
        if any(setting in settings[:i] for i, setting in enumerate(settings)):
            raise OptionError(f"sweep {field}: has the same value twice. Remove one.")
        names = _class_names(field, values)
        classes += [
            SuiteClass(name=each, setting=setting, seeds=seeds)
            for each, setting in zip(names, settings, strict=True)
            if not classes or setting != classes[0].setting
        ]
    return tuple(classes)


def instance_seeds(seed: int | str, instances: int) -> tuple[int | str, ...]:
    """The seeds of a class's instances: a task's own, and the integers that follow it."""
    if instances == 1:
        return (seed,)
    if isinstance(seed, str):
        raise OptionError(
            f"instances={instances}: must be 1 for a task with the hexadecimal seed {seed}. "
            "Leave it out."
        )
    return tuple(range(seed, seed + instances))


def _check_axis(field: str, values: Sequence[Any]) -> None:
    if field == "seed":
        raise OptionError(
            "sweep seed: is no axis. Give the number of instances (--instances) for several draws "
            "of each class."
        )
    if not values:
        raise OptionError(f"sweep {field}: has no values. Give some, such as {field}=1,2,5.")


def _with(fields: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy of plain data with one value replaced; `path` is dotted."""
    changed: dict[str, Any] = json.loads(json.dumps(fields))
    *outer, last = path.split(".")
    place: Any = changed
    for part in outer:
        place = _entry(place, part, path)
    if isinstance(place, list):
        place[_index(place, last, path)] = value
    elif isinstance(place, dict):
        place[last] = value
    else:
        raise _no_such_field(path)
    return changed


def _entry(place: Any, part: str, path: str) -> Any:
    if isinstance(place, list):
        return place[_index(place, part, path)]
    if not isinstance(place, dict) or part not in place:
        raise _no_such_field(path)
    return place[part]


def _index(entries: list[Any], text: str, path: str) -> int:
    if not text.isdigit() or int(text) >= len(entries):
        raise OptionError(
            f"sweep {path}: {text!r} must be a number from 0 to {len(entries) - 1}, the place of "
            "an entry in its list."
        )
    return int(text)


def _no_such_field(path: str) -> OptionError:
    return OptionError(
        f"sweep {path}: this task has no such field. Start from a task that has it, such as a "
        "team for team.reward."
    )


def _class_names(field: str, values: Sequence[Any]) -> list[str]:
    """`k-5`, `r_min-0_5`, as in the catalogue; numbers from 0 where values are lists."""
    stem = field.replace(".", "-")
    texts = [re.sub(r"[^A-Za-z0-9]+", "_", _text(value)).strip("_") for value in values]
    plain = all(isinstance(value, str | int | float) for value in values)
    if not plain or len(set(texts)) < len(texts) or len(stem) + max(map(len, texts)) > 60:
        texts = [str(i) for i in range(len(values))]
    return [f"{stem[: _LONGEST_NAME - 1 - len(text)]}-{text}" for text in texts]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else short_repr(value)
