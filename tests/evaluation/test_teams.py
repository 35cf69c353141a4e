"""Teams: each agent is evaluated over its own channels, from what it alone observes."""

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate, materialize
from sme_registry.errors import PolicyError
from sme_registry.evaluation import references
from sme_registry.evaluation.policies import as_policy
from sme_registry.teams import (
    shared_action_dim,
    shared_observation,
    shared_observation_dim,
)
from tests.evaluation.kinds import (
    NAMES,
    PROTOCOL,
    SLANTED,
    SMALL,
    WIDTHS,
    half,
    numbers,
    observations,
    report_of,
)
from tests.evaluation.kinds import TEAM as SPEC

TASK = materialize(SPEC)


def optimal(agent):
    """An agent's optimal policy, from its own observations alone."""
    channels, own = list(TASK.observed[agent]), TASK.owned[agent]

    def act(observations):
        s = np.full((len(observations), 4), 0.123)
        s[:, channels] = observations[:, : len(channels)]
        return TASK.optimal_action(s)[:, own]

    return act


@pytest.fixture
def report():
    return report_of("team")


@pytest.mark.parametrize("complexity", [1, 3])
@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_every_agent_attains_its_optimum_from_what_it_observes(monkeypatch, backend, complexity):
    if backend == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", backend)
    spec = SPEC.derive(complexity=complexity)
    monkeypatch.setitem(globals(), "TASK", materialize(spec))
    result = evaluate({name: optimal(i) for i, name in enumerate(NAMES)}, spec, PROTOCOL)
    for scope in (result, *result.agents.values()):
        for region in scope.regions:
            assert region.normalised_regret == pytest.approx(0.0, abs=1e-9)
            assert region.similarity == pytest.approx(1.0, abs=1e-9)


def test_an_agents_numbers_are_those_of_the_definition(report):
    assert tuple(report.agents) == NAMES
    for index in range(6):
        o = observations(PROTOCOL, index, SPEC)
        best = TASK.optimal_action(o[:, :4].astype(np.float64))
        parts, clipped = [], []
        for agent, (name, own) in enumerate(zip(NAMES, TASK.owned, strict=True)):
            raw = SLANTED[name](o[:, [*TASK.observed[agent], 4, 5]]).astype(np.float64)
            a = np.clip(raw, 0.0, 1.0)
            missed = np.abs(a - best[:, own])
            region = report.agents[name].regions[index]
            assert region.similarity == pytest.approx(1.0 - missed.mean(), abs=1e-12)
            spread = missed.mean(axis=1).std(ddof=1)
            assert region.similarity_sd == pytest.approx(spread, abs=1e-12)
            floor = np.abs(0.5 - best[:, own]).mean()
            assert region.normalised_regret == pytest.approx(missed.mean() / floor, abs=1e-12)
            assert region.clipped_share == np.mean(raw != a)
            clipped.append(raw != a)
            assert len(region.channels) == a.shape[1]
            parts.append(a)
        whole = TASK.similarity(o[:, :4].astype(np.float64), np.concatenate(parts, axis=1))
        assert report.regions[index].similarity == pytest.approx(whole.mean(), abs=1e-12)
        share = np.mean(np.concatenate(clipped, axis=1))
        assert report.regions[index].clipped_share == pytest.approx(share, abs=1e-12)
        assert index == 0 or share > 0.0


def test_every_agent_has_every_reference_and_the_teams_channels_are_theirs_in_order(report):
    for agent in report.agents.values():
        assert tuple(agent.references) == references.NAMES
        assert all(row.normalised_regret == 0.0 for row in agent.references["optimal"])
        assert all(row.normalised_regret == 1.0 for row in agent.references["constant"])
        inside = {name: rows[0].normalised_regret for name, rows in agent.references.items()}
        assert 0.0 < inside["linear"] < inside["best_constant"] <= 1.0
    for name, rows in {"": report.regions, **report.references}.items():
        for index, region in enumerate(rows):
            agents = report.agents.values()
            own = [agent.references[name] if name else agent.regions for agent in agents]
            assert region.channels == sum((rows[index].channels for rows in own), ())


def test_the_linear_reference_of_an_agent_is_fitted_on_what_it_observes():
    rng = np.random.default_rng(0)
    s = rng.random((3_000, 4))
    best = TASK.optimal_action(s)
    fitted = references.fit(TASK, s, best)
    for channels, own in zip(TASK.observed, TASK.owned, strict=True):
        seen, optimal = s[:, channels], best[:, own]
        single = materialize(SMESpec(state_dim=seen.shape[1], action_dim=optimal.shape[1]))
        alone = references.fit(single, seen, optimal)
        assert fitted.slope[list(channels), own] == pytest.approx(alone.slope, abs=1e-12)
        assert fitted.intercept[own] == pytest.approx(alone.intercept, abs=1e-12)
        unseen = [channel for channel in range(4) if channel not in channels]
        assert not fitted.slope[unseen, own].any()
    single = materialize(SMESpec(state_dim=4, action_dim=best.shape[1]))
    together = references.fit(single, s, best)
    assert together.slope[1, 0] != 0.0  # one map of the whole state would not be the agents'


def test_a_team_of_one_has_the_numbers_of_its_single_agent_task():
    single = SMESpec(state_dim=4, action_dim=3, complexity=3)
    team = single.derive(team={"agents": [{"action_dim": 3}]})

    def policy(observations):
        return observations[:, :3] ** 2 * 1.1

    alone = evaluate(policy, single, PROTOCOL)
    for policies in ({"agent_0": policy}, policy):
        result = evaluate(policies, team, PROTOCOL)
        for scope in (result, result.agents["agent_0"]):
            assert scope.regions == alone.regions
            assert scope.references == alone.references


def test_references_act_for_teams_and_for_their_agents_by_name():
    # Some are fitted on other states.
    tolerances = {"optimal": 1e-9, "constant": 0, "best_constant": 0.05, "linear": 0.05}
    for name, near in {**tolerances, "random": 0.3}.items():
        for agent in evaluate(name, SPEC, SMALL).agents.values():
            region, expected = agent.regions[0], agent.references[name][0]
            assert region.normalised_regret == pytest.approx(expected.normalised_regret, abs=near)
    mixed = {**dict.fromkeys(NAMES, "optimal"), NAMES[1]: "constant"}
    report = evaluate(mixed, SPEC, SMALL)
    regrets = [report.agents[name].regions[0].normalised_regret for name in NAMES]
    assert regrets == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)


def test_a_prepared_team_is_accepted_as_it_is_for_its_own_agents():
    prepared = as_policy("linear", SPEC)
    assert as_policy(prepared, SPEC) is prepared
    assert (prepared.name, evaluate(prepared, SPEC, SMALL).policy) == ("linear", "linear")
    for other in (SPEC.derive(team=None), "Team2"):
        with pytest.raises(PolicyError, match=r"acts for the agents left_0 \(1 channels\), "):
            evaluate(prepared, other, SMALL)


def test_a_shared_policy_observes_what_its_agent_does_and_which_it_is():
    joint = np.array([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]], np.float32)
    expected = [
        [0.1, 0.0, 0.3, 0.0, 0.5, 0.6, 1, 0, 0],
        [0.0, 0.2, 0.3, 0.4, 0.5, 0.7, 0, 1, 0],
        [0.1, 0.2, 0.3, 0.4, 0.5, 0.8, 0, 0, 1],
    ]
    shown = shared_observation(TASK, joint)
    assert shown.dtype == np.float32
    np.testing.assert_array_equal(shown, np.array([expected], np.float32))
    assert (shared_observation_dim(TASK), shared_action_dim(TASK)) == (9, 3)
    seen = []

    def policy(observations):
        seen.append(observations.copy())
        observations[:] = np.nan  # reaches no other agent
        return np.full((len(observations), 3), 0.5)

    evaluate(policy, SPEC, SMALL)
    for index in range(2):
        o = observations(SMALL, index, SPEC)
        joint = np.concatenate([o, np.zeros((200, 2), np.float32)], axis=1)
        expected = shared_observation(TASK, joint)
        for agent in range(3):
            np.testing.assert_array_equal(seen[3 * index + agent], expected[:, agent])


def test_a_shared_policy_scores_as_separate_ones_that_do_the_same():
    def shared(observations):  # the first observed channel, which differs between the agents
        channel = np.where(observations[:, 7] == 1, observations[:, 1], observations[:, 0])
        return np.stack([channel, 2.0 * channel, -channel], axis=1)

    def own(width):
        return lambda o: np.stack([o[:, 0], 2.0 * o[:, 0], -o[:, 0]], axis=1)[:, :width]

    separate = {name: own(width) for name, width in zip(NAMES, WIDTHS, strict=True)}
    assert numbers(evaluate(shared, SPEC, PROTOCOL)) == numbers(evaluate(separate, SPEC, PROTOCOL))


def with_(**changed):
    policies = {**SLANTED, **changed}
    return {name: policy for name, policy in policies.items() if policy != "left out"}


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (with_(right_1="left out"), r"right_1: policy missing\. Give one for each of left_0, rig"),
        (
            {"left_0": half(1), "right_0": half(3), "rigth_1": half(2)},
            r"right_1: policy missing\. 'rigth_1': no such agent\. Did you mean 'right_1'\?",
        ),
        (with_(extra_7=half(1)), r"'extra_7': no such agent\. Give one for each of left_0"),
        (with_(right_0=half(2)), r"^right_0: .*\(200, 2\): must be of shape \(200, 3\)"),
        (with_(right_1=half(3)), r"^right_1: .*must be of shape \(200, 2\)"),
        (with_(right_1=lambda o: np.full((len(o), 2), np.nan)), r"^right_1: .*NaN or infinite"),
        (with_(left_0=lambda o: 1 / 0), r"^left_0: .*ZeroDivisionError"),
        (with_(right_0=None), r"^right_0: policy=None: must be a callable .*\[B, 5\] .*\[B, 3\]"),
        (with_(right_0="absent.zip"), r"^right_0: absent\.zip does not exist"),
        (None, r"must be a callable .*\[B, 9\] to .*\[B, 3\].*pass a dict by agent"),
        (half(6), r"^left_0: .*\(200, 6\): must be of shape \(200, 3\).*called for each agent"),
        (lambda o: o @ np.ones((6, 6)), r"^left_0: .*ValueError: .* for separate policies pass a"),
        (lambda o: np.where(o[:, 7:8] == 1, np.nan, np.full((len(o), 3), 0.5)), "^right_0: .*NaN"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_by_whose_it_is(policy, message):
    with pytest.raises(PolicyError, match=message):
        evaluate(policy, SPEC, SMALL)


def test_policies_are_named_alike_or_counted():
    def careful(observations):
        return observations[:, :1]

    assert as_policy(dict.fromkeys(NAMES, careful), SPEC).name == "careful"
    assert as_policy({**SLANTED, "left_0": careful}, SPEC).name == "3 policies"
    assert as_policy(SLANTED, SPEC, name="mine").name == "mine"
    assert as_policy(careful, SPEC).name == "careful"


def test_symmetric_actions_of_all_agents_are_rescaled(report):
    doubled = {name: (lambda o, act=act: 2.0 * act(o) - 1.0) for name, act in SLANTED.items()}
    result = evaluate(doubled, SPEC, PROTOCOL, action_range="symmetric")
    assert result.action_range == "symmetric"
    assert numbers(result) == pytest.approx(numbers(report), abs=1e-6)


@pytest.fixture(scope="module")
def sb3():
    return pytest.importorskip("stable_baselines3")


def model(sb3, observation_dim, action_dim, low=0.0):
    import gymnasium
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Spaces(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0.0, 1.0, (observation_dim,), np.float32)
        action_space = gymnasium.spaces.Box(low, 1.0, (action_dim,), np.float32)

    return sb3.PPO("MlpPolicy", DummyVecEnv([Spaces]), device="cpu", seed=3)


def test_a_shared_model_scores_as_its_file(sb3, tmp_path):
    ppo = model(sb3, 9, 3, low=-1.0)
    ppo.save(tmp_path / "team.zip")
    live, saved = evaluate(ppo, SPEC, SMALL), evaluate(tmp_path / "team.zip", SPEC, SMALL)
    assert (live.policy, saved.policy) == ("PPO", "team")
    assert live.action_range == saved.action_range == "symmetric"
    assert numbers(live) == numbers(saved)
    with pytest.raises(PolicyError, match=r"shape \(6,\): must be \(9,\) for a policy that all 3"):
        evaluate(model(sb3, 6, 6), SPEC, SMALL)


def test_models_of_each_agents_own_are_taken_with_their_own_action_ranges(sb3):
    left = model(sb3, 4, 1, low=-1.0)
    policies = {"left_0": left, "right_0": model(sb3, 5, 3), "right_1": half(2)}
    result = evaluate(policies, SPEC, SMALL)
    assert result.action_range == "mixed"

    def predicted(observations):
        action = left.predict(observations, deterministic=True)[0]
        return (action.astype(np.float64) + 1.0) / 2.0

    again = evaluate({**policies, "left_0": predicted}, SPEC, SMALL)
    mine, theirs = result.agents["left_0"].regions, again.agents["left_0"].regions
    assert [r.mae for r in mine] == pytest.approx([r.mae for r in theirs], abs=1e-6)
    with pytest.raises(PolicyError, match=r"^right_0: .*shape \(4,\): must be \(5,\) for 3 obs"):
        evaluate({**SLANTED, "right_0": model(sb3, 4, 3)}, SPEC, SMALL)
