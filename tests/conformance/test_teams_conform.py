"""Every team of the catalogue keeps every promise: PettingZoo's and ours, by name, by content."""

import warnings

import pettingzoo
import pytest
from pettingzoo.utils.conversions import aec_to_parallel, parallel_to_aec

import sme_registry
from sme_registry import SMESpec, testing
from sme_registry.spec import catalogue
from sme_registry.spec.envelope import EnvFile

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # importing PettingZoo's tests warns of their own module's age
    from pettingzoo.test import api_test, render_test, seed_test

TEAMS = [file.versioned_name for file in catalogue.entries(EnvFile) if file.spec.team is not None]
UNEQUAL = {
    "agents": [
        {"name": "scout_0", "action_dim": 1, "observes": [0, 2]},
        {"name": "driver_0", "action_dim": 2},
        {"name": "scout_1", "action_dim": 1, "observes": [1]},
    ]
}


@pytest.mark.parametrize("name", ["Team2", "TeamBlindShared4", "DuoDeep", "HardFragile"])
def test_a_team_of_each_kind_passes_the_conformance_kit(name):
    testing.check_team(name)


@pytest.mark.parametrize(
    "fields",
    [
        {"horizon": 1, "action_dim": 2, "team": {"agents": [{"action_dim": 1}] * 2}},
        {"k": 3, "r_min": 0.2, "D": 0.3, "horizon": 10, "team": UNEQUAL},
        {"k": 50, "horizon": 12, "D": 0.4, "team": {**UNEQUAL, "reward": "team"}},
        {"team": {"agents": [{"name": "lone_7", "action_dim": 4, "observes": [1, 3]}]}},
    ],
    ids=["short", "fragile", "shared", "lone"],
)
def test_teams_at_the_edges_pass_the_conformance_kit(fields):
    testing.check_team(fields)


def test_a_team_in_turns_by_make_aec_passes_pettingzoos_tests():
    api_test(sme_registry.make_aec("Team4-v1", horizon=20), num_cycles=100)
    seed_test(lambda: sme_registry.make_aec("Team4-v1", horizon=20))


def test_a_team_passes_pettingzoos_render_test(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(lambda render_mode: sme_registry.make_aec("Team2", render_mode=render_mode))


def test_teams_are_in_pettingzoos_registry_by_name_and_by_content():
    assert {"Team2-v1", "Team4-v1", "Team8-v1", "TeamBlind4-v1", "TeamShared4-v1"} <= set(TEAMS)
    for name in TEAMS:
        spec = sme_registry.load(name)
        for env_id in (f"SME/{name}", f"SME/{spec.content_name}-v1"):
            assert pettingzoo.make("parallel", env_id).sme_spec == spec
            assert pettingzoo.make("aec", env_id).unwrapped.sme_spec == spec
            assert pettingzoo.make("parallel", env_id, seed=5).sme_spec == spec.derive(seed=5)


def test_single_agents_stay_out_of_pettingzoos_registry_and_teams_out_of_gymnasiums():
    import gymnasium

    ours = {env_id for env_id in pettingzoo.parallel_registry if env_id.startswith("SME/")}
    assert ours == {env_id for env_id in pettingzoo.aec_registry if env_id.startswith("SME/")}
    assert {f"SME/{name}" for name in TEAMS} <= ours
    assert not ours & gymnasium.registry.keys()


def test_a_spec_of_your_own_with_a_team_is_made_by_its_name():
    spec = SMESpec(team=UNEQUAL, seed=301)
    assert sme_registry.register(spec, "ApiTrio") == "SME/ApiTrio-v1"
    assert pettingzoo.make("parallel", "SME/ApiTrio-v1").sme_spec == spec
    assert sme_registry.make_parallel("ApiTrio").sme_spec == spec
    with pytest.raises(sme_registry.SMEError, match="stands for another spec"):
        sme_registry.register(SMESpec(seed=302), "ApiTrio")


def test_a_team_is_made_from_an_id_a_path_a_digest_a_spec_and_its_fields(tmp_path):
    spec = sme_registry.load("DuoDeep")
    path = sme_registry.save(spec, tmp_path / "duo.json")
    for given in ("SME/DuoDeep-v1", "DuoDeep", path, str(path), spec.digest, spec, spec.to_dict()):
        assert sme_registry.make_parallel(given).sme_spec == spec
        assert sme_registry.make_aec(given).unwrapped.sme_spec == spec


def test_the_conversion_back_from_turns_gives_the_environment_itself():
    env = sme_registry.make_parallel("Team2")
    assert aec_to_parallel(parallel_to_aec(env)) is env
    assert aec_to_parallel(sme_registry.make_aec("Team2")).sme_spec == env.sme_spec
