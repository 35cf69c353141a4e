"""Hypothesis strategies for valid documents, small enough to be drawn and stepped at once."""

from __future__ import annotations

import itertools
from typing import Any

from hypothesis import strategies as st

from sme_registry.spec import SMESpec

SEEDS = st.one_of(
    st.integers(0, 2**53 - 1),
    st.integers(0, 2**256 - 1).map(lambda number: f"0x{number:x}"),
)
THRESHOLDS = st.one_of(
    st.sampled_from([0.0, 0.25, 0.5, 0.95]), st.floats(0.0, 1.0, exclude_max=True)
)

ANGLES = st.one_of(st.just(0.0), st.floats(0.0, 6.28))


@st.composite
def teams(draw: st.DrawFn, state_dim: int, action_dim: int) -> dict[str, Any]:
    """Teams that share out `action_dim` channels and observe any of `state_dim`."""
    cuts = draw(st.sets(st.integers(1, action_dim - 1), max_size=3)) if action_dim > 1 else set()
    borders = [0, *sorted(cuts), action_dim]
    channels = st.lists(st.integers(0, state_dim - 1), min_size=1, unique=True).map(sorted)
    agents = [
        {"action_dim": high - low, "observes": draw(st.one_of(st.just("all"), channels))}
        for low, high in itertools.pairwise(borders)
    ]
    return {"agents": agents, "reward": draw(st.sampled_from(["individual", "team"]))}


SAFETY = st.fixed_dictionaries(
    {"tightness": st.floats(0.0, 0.5, exclude_min=True), "compensated": st.booleans()}
)
SHAPING = st.fixed_dictionaries(
    {"scale": st.floats(0.01, 100.0), "discount": st.sampled_from([1.0, 0.9, 0.0])}
)
NOISE = st.fixed_dictionaries({"reward": st.floats(0.0, 10.0), "transition": st.floats(0.01, 1.0)})


@st.composite
def observations(draw: st.DrawFn) -> dict[str, Any]:
    """What an agent may see in place of the state; fields that have a default may be left out."""
    mixing = draw(st.sampled_from(["none", "orthogonal", "nonlinear"]))
    m = draw(st.integers(1 if mixing == "none" else 0, 5))
    fields = {"distractors": m, "mixing": mixing}
    if m and draw(st.booleans()):
        fields["dynamics"] = draw(st.sampled_from(["noise", "autonomous", "driven"]))
    if mixing == "nonlinear" and draw(st.booleans()):
        fields["mixing_depth"] = draw(st.integers(1, 3))
    return fields


@st.composite
def spec_fields(
    draw: st.DrawFn, team: bool | None = None, *, plain: bool = False
) -> dict[str, Any]:
    """The fields of a valid spec; `plain` leaves out what METHOD's section 1 does not have."""
    state_dim, action_dim = draw(st.integers(1, 6)), draw(st.integers(1, 5))
    fields = {
        "state_dim": state_dim,
        "action_dim": action_dim,
        "k": draw(st.integers(1, 10)),
        "r_min": draw(THRESHOLDS),
        "D": draw(THRESHOLDS),
        "complexity": draw(st.integers(1, 4)),
        "horizon": draw(st.integers(1, 30)),
        "hidden_width": draw(st.sampled_from([1, 2, 5, 16, 20])),
        "policy_init": draw(st.sampled_from(["semi_orthogonal", "unit_variance"])),
        "seed": draw(SEEDS),
    }
    if draw(st.booleans()) if team is None else team:
        fields["team"] = draw(teams(state_dim, action_dim))
    elif not plain:
        if fields["D"] == 0.0 and draw(st.booleans()):
            fields["safety"] = draw(SAFETY)
        if draw(st.booleans()):
            fields["observation"] = draw(observations())
    if not plain:
        fields |= {
            name: draw(block)
            for name, block in (("shaping", SHAPING), ("noise", NOISE))
            if draw(st.booleans())
        }
    agents = fields.get("team", {}).get("agents", [])
    if state_dim > 1 and all(len(agent["observes"]) > 1 for agent in agents):
        fields["rotation"] = draw(ANGLES)
    return fields


def specs(team=None, *, plain=False):
    """Valid specs; see `spec_fields`."""
    return spec_fields(team, plain=plain).map(SMESpec.from_dict)
