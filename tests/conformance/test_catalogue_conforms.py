"""Single agents' environments keep every promise: one id of each kind, and specs at the edges.

That every entry of the catalogue is drawn and stepped as published is in `tests/spec`, kinds of
safety and observation are in `tests/envs/test_extension.py`, teams in `test_teams_conform.py`.
"""

from __future__ import annotations

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

import sme_registry
from sme_registry import testing
from sme_registry.spec import catalogue
from sme_registry.spec.envelope import EnvFile

NAMES = [file.versioned_name for file in catalogue.entries(EnvFile) if file.spec.team is None]
KINDS = ["Default", "StateDim64", "ActionDim16", "Plane10", "HardFragile", "HardSafeMixed"]


@pytest.mark.parametrize("name", KINDS)
def test_an_entry_of_each_kind_passes_the_conformance_kit(name: str) -> None:
    testing.check_sme(f"SME/{name}-v1")


@pytest.mark.parametrize("name", ["Default", "HardSafeMixed"])
def test_ids_pass_the_checkers_of_gymnasium_and_sb3(name: str) -> None:
    # With the id, and so the EnvSpec: check_env then also makes and tries each render mode.
    check_env(gymnasium.make(f"SME/{name}-v1").unwrapped, skip_render_check=name != "Default")
    sb3_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.make(f"SME/{name}-v1", action_range="symmetric")
    sb3_checker.check_env(env.unwrapped, warn=True)


def test_every_catalogue_entry_has_an_id_by_name_and_one_by_content() -> None:
    assert "Default-v1" in NAMES
    for name in NAMES:
        spec = sme_registry.load(name)
        for env_id in (f"SME/{name}", f"SME/{spec.content_name}-v1"):
            env = gymnasium.make(env_id)
            assert env.spec.id == env_id
            assert env.unwrapped.sme_spec == spec
            sent = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
            assert gymnasium.make(sent).unwrapped.sme_spec.digest == spec.digest


@pytest.mark.parametrize(
    "fields",
    [
        {"horizon": 1, "state_dim": 1, "action_dim": 1},
        {"k": 7, "D": 0.75, "r_min": 0.9, "horizon": 20, "complexity": 3},
        {"k": 50, "horizon": 12},
        {"state_dim": 3, "action_dim": 9, "hidden_width": 5, "complexity": 4, "horizon": 15},
        {"seed": "0xabcdef0123456789", "policy_init": "unit_variance", "complexity": 2,
         "horizon": 10},
    ],
    ids=lambda fields: ",".join(fields),
)  # fmt: skip
def test_specs_at_the_edges_pass_the_conformance_kit(fields: dict[str, object]) -> None:
    testing.check_sme(fields)
