"""Sweeps: classes that differ from a task in one field each."""

from __future__ import annotations

import pytest

from sme_registry import SMEError, load
from sme_registry.cli.plan_options import sweep_axes
from sme_registry.spec import SMESpec
from sme_registry.spec.sweep import sweep


def test_a_single_axis_has_one_class_for_each_value() -> None:
    classes = sweep(SMESpec(seed=3), {"r_min": [0, 0.25, 0.5]}, instances=2)
    assert [member.name for member in classes] == ["r_min-0", "r_min-0_25", "r_min-0_5"]
    assert [member.setting.r_min for member in classes] == [0.0, 0.25, 0.5]
    assert {member.seeds for member in classes} == {(3, 4)}


def test_several_axes_share_the_task_itself() -> None:
    classes = sweep(SMESpec(), {"k": [1, 5], "complexity": [1, 10]}, name="Default")
    assert [member.name for member in classes] == ["Default", "k-5", "complexity-10"]
    assert classes[2].setting.k == 1  # no cross product


def test_values_are_json_or_text_and_a_field_of_a_team_has_a_dotted_name() -> None:
    axes = sweep_axes(["k=1,2,5", "policy_init=semi_orthogonal,unit_variance"])
    assert axes == {"k": [1, 2, 5], "policy_init": ["semi_orthogonal", "unit_variance"]}
    classes = sweep(load("Team2"), sweep_axes(['team.agents.0.observes=[0],"all"']))
    assert [member.name for member in classes] == [
        "team-agents-0-observes-0", "team-agents-0-observes-1",
    ]  # fmt: skip
    observed = [member.instances[0].team.agents[0].observes for member in classes]  # type: ignore[union-attr]
    assert observed == [(0,), "all"]


def test_bad_axes_are_refused() -> None:
    for axes, words in (
        ({"kk": [1]}, "kk"),
        ({"k": [0, 1]}, "k=0"),
        ({"k": [1, 1]}, "twice"),
        ({"k": []}, "no values"),
        ({"seed": [1, 2]}, "--instances"),
        ({"team.reward": ["team"]}, "no such field"),
    ):
        with pytest.raises(SMEError, match=words):
            sweep(SMESpec(), axes)
