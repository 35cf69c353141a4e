"""Every single agent's environment of the catalogue, as found in the folder, keeps every promise.

Teams are in `test_teams_conform.py`.
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
IDS = [f"SME/{name}" for name in NAMES]


def test_the_catalogue_is_found() -> None:
    assert "SME/Default-v1" in IDS


@pytest.mark.parametrize("env_id", IDS)
def test_every_catalogue_entry_passes_the_conformance_kit(env_id: str) -> None:
    testing.check_sme(env_id)


@pytest.mark.parametrize("env_id", IDS)
def test_every_catalogue_entry_passes_gymnasiums_check_env_by_its_id(env_id: str) -> None:
    # With the id, and so the EnvSpec: check_env then also makes and tries each render mode.
    headless = env_id != "SME/Default-v1"
    check_env(gymnasium.make(env_id).unwrapped, skip_render_check=headless)


@pytest.mark.parametrize("env_id", IDS)
def test_every_catalogue_entry_passes_sb3s_check_env(env_id: str) -> None:
    sb3_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.make(env_id, action_range="symmetric")
    sb3_checker.check_env(env.unwrapped, warn=True)


@pytest.mark.parametrize("name", NAMES)
def test_every_catalogue_entry_has_an_id_by_name_and_one_by_content(name: str) -> None:
    spec = sme_registry.load(name)
    for env_id in (f"SME/{name}", f"SME/{spec.content_name}-v1"):
        env = gymnasium.make(env_id)
        assert env.spec is not None
        assert env.spec.id == env_id
        assert env.unwrapped.sme_spec == spec
        sent = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
        assert gymnasium.make(sent).unwrapped.sme_spec.digest == spec.digest


@pytest.mark.parametrize(
    "fields",
    [
        {"horizon": 1, "state_dim": 1, "action_dim": 1},
        {"k": 3, "r_min": 0.2, "D": 0.5, "horizon": 10},
        {"k": 7, "D": 0.75, "r_min": 0.9, "horizon": 20, "complexity": 3},
        {"k": 50, "horizon": 12},
        {"state_dim": 3, "action_dim": 9, "hidden_width": 5, "complexity": 4, "horizon": 15},
        {"seed": "0xabcdef0123456789", "policy_init": "unit_variance", "complexity": 2},
    ],
    ids=lambda fields: ",".join(fields),
)
def test_specs_at_the_edges_pass_the_conformance_kit(fields: dict[str, object]) -> None:
    testing.check_sme(fields)
