"""Critics against exact values: whose value, which order of actions, and models without one."""

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import SMEError
from sme_registry.spec import SMESpec

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import DDPG, PPO, SAC, TD3

from sme_registry.datasets import train_offline
from sme_registry.datasets.documents import BCHyperparameters, IQLHyperparameters
from sme_registry.datasets.learners import OfflineLearner
from sme_registry.diagnosis import critic, diagnose, load_policy, load_run
from sme_registry.diagnosis.critics import CriticRegion, CriticReport, CriticTime
from sme_registry.diagnosis.figures import draw
from sme_registry.diagnosis.task import diagnosed
from tests.datasets.sets import transitions_of
from tests.diagnosis.policies import DEEP, SPEC, diagnosis_of

SMALL = {"horizon": 20, "state_dim": 3, "action_dim": 2}


def model(algorithm, gamma=0.9, action_range="unit", spec=None, **options):
    """An untrained model: what it is compared with does not depend on what it has learnt."""
    options |= {"buffer_size": 10} if algorithm is not PPO else {}
    env = sme_registry.make(spec or SMESpec(**SMALL), action_range=action_range)
    return algorithm("MlpPolicy", env, seed=0, gamma=gamma, **options)


class Judge(torch.nn.Module):
    """A critic that says what a function of s, t and actions in [0, 1] says."""

    def __init__(self, says):
        super().__init__()
        self.says = says

    def forward(self, seen, actions):
        seen, unit = seen.numpy().astype(float), (actions.numpy().astype(float) + 1) / 2
        return (torch.tensor(self.says(seen[:, :3], seen[:, 3], unit))[:, None],)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
@pytest.mark.parametrize("algorithm", [TD3, DDPG])
def test_the_value_of_an_actor_is_that_of_its_deterministic_first_action(algorithm, action_range):
    report = critic(model(algorithm, gamma=0.0, action_range=action_range), SMESpec(**SMALL))
    assert report.kind == "Q"
    assert [region.region for region in report.regions] == ["visited", "WD"] + [
        f"OOD {m}" for m in range(1, 6)
    ]
    cube = report.region("WD")
    assert cube.continuing == pytest.approx(cube.finite)  # nothing follows at γ = 0
    assert cube.bias == pytest.approx(cube.claim - cube.finite)


def test_of_td3_the_target_noise_belongs_to_the_value_and_of_sac_the_entropy():
    still, noisy = (
        critic(model(TD3, target_policy_noise=spread), SMESpec(**SMALL), states=500).region("WD")
        for spread in (0.0, 2.0)
    )
    assert still.claim == noisy.claim
    assert abs(still.finite - noisy.finite) > 0.02
    plain, with_entropy, at_once = (
        critic(model(SAC, ent_coef=alpha, gamma=gamma), SMESpec(**SMALL)).region("WD")
        for alpha, gamma in ((0.0, 0.9), (1.0, 0.9), (1.0, 0.0))
    )
    assert with_entropy.finite - plain.finite > 1.0  # an untrained Gaussian has entropy
    assert at_once.finite < 1.0  # none of it belongs to the first action


def test_a_state_value_is_of_the_clipped_gaussian_and_needs_no_sweeps():
    policy = model(PPO, gamma=0.0)
    report = critic(policy, SMESpec(**SMALL), states=2000)
    assert (report.kind, report.sweeps, report.region("WD").ranking) == ("V", None, None)
    task = sme_registry.materialize(SMESpec(**SMALL))
    s = np.random.default_rng(0).uniform(size=(2000, 3))
    seen = np.column_stack([s, np.full(2000, 0.5), np.zeros(2000)]).astype(np.float32)
    actions, _ = policy.predict(seen, deterministic=False)
    expected = task.step_reward(s, actions).mean()
    assert report.region("WD").finite == pytest.approx(expected, abs=0.03)


def test_a_critic_that_knows_the_reward_ranks_perfectly_and_its_opposite_never():
    task, judged = sme_registry.materialize(SMESpec(**SMALL)), model(TD3)
    for sign, share in ((1, 1), (-1, 0)):
        judged.policy.critic = Judge(lambda s, t, a, sign=sign: sign * task.step_reward(s, a))
        ranking = critic(judged, task.spec, states=50).region("WD").ranking
        assert ranking == pytest.approx(share, abs=0.01)


def test_where_no_two_actions_differ_in_reward_there_is_no_ranking():
    never_paid = SMESpec(**SMALL, r_min=0.999)
    subject = load_policy(model(TD3, spec=never_paid), never_paid)
    diagnosis = diagnose(subject, states=64, episodes=8)
    assert diagnosis.measurements.critic.region("WD").ranking is None
    verdict = diagnosis.verdict("critic_ranking")
    assert (verdict.answer, verdict.reason) == ("cannot tell", "rewards_alike")


def test_a_critic_that_shaping_misleads_is_told_from_one_that_has_not_learnt():
    spec = SMESpec(**SMALL, shaping={"scale": 30})
    task, judged = sme_registry.materialize(spec), model(TD3, gamma=0.5, spec=spec)

    def misled(s, t, a):
        later = task.potential(task.transition(s, a), t * spec.horizon + 1)
        return task.step_reward(s, a) + 0.5 * later

    judged.policy.critic = Judge(misled)
    cube = critic(judged, spec, states=50).region("WD")
    assert cube.misled_ranking > 0.99
    assert cube.ranking < 0.8


def test_levels_over_time_fall_towards_the_end_of_an_episode_and_continuing_ones_do_not():
    report = critic(model(TD3), SMESpec(**SMALL), states=1000)
    first, last = report.times[0], report.times[-1]
    assert len(report.times) == 10
    assert last.finite < 0.5 * first.finite
    assert last.continuing > 0.8 * first.continuing
    assert critic(model(TD3, gamma=1.0), SMESpec(**SMALL), states=20).times[0].continuing is None


@pytest.mark.parametrize(
    ("judged", "arguments", "says"),
    [
        (lambda: model(PPO), {"task": "Default"}, "trained on"),
        (lambda: model(PPO), {"task": "Team2"}, "agents"),
        (lambda: model(PPO), {"states": 0}, "states=0"),
        (lambda: model(PPO), {"seed": -1}, "seed=-1"),
        (lambda: object(), {}, "no critic"),
    ],
)
def test_a_model_without_that_critic_is_refused(judged, arguments, says):
    with pytest.raises(SMEError, match=says):
        critic(judged(), **{"task": SMESpec(**SMALL)} | arguments)


def report_of(ranking=0.9, outside=0.9, misled=None, bias=0.0, gamma=0.9, sweeps=100.0):
    """What `critic` could find: the rankings in the cube and in the outermost shell, and a bias."""

    def region(name, share):
        return CriticRegion(
            region=name, states=100, ranking=share, misled_ranking=misled, claim=1.0 + bias,
            finite=1.0, continuing=1.0, bias=bias, bias_share=bias,
        )  # fmt: skip

    shares = {"visited": ranking, "WD": ranking, "OOD 5": outside}
    kind = "V" if ranking is None else "Q"
    return CriticReport(
        algorithm="TD3", kind=kind, spec_digest=SPEC.digest, gamma=gamma, sweeps=sweeps, seed=0,
        regions=[region(name, share) for name, share in shares.items()],
        times=[CriticTime(time=0.5, claim=1.0 + bias, finite=0.5, continuing=1.0)],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "question", "reason"),
    [
        ({"ranking": 0.9}, "critic_ranking", "critic_ahead_of_actor"),
        ({"ranking": 0.5}, "critic_ranking", "critic_ranks_badly"),
        ({"ranking": 0.7}, "critic_ranking", "critic_between"),
        ({"ranking": None, "outside": None}, "critic_ranking", "critic_of_states"),
        ({"outside": 0.5}, "critic_outside", "ranks_inside_only"),
        ({}, "critic_outside", "ranks_alike"),
        ({"ranking": 0.5, "misled": 0.9}, "discount", "misled_by_discount"),
        ({"ranking": 0.5, "misled": 0.5}, "discount", "neither_learnt"),
        ({"ranking": 0.9, "misled": 0.5}, "discount", "not_misled"),
        ({}, "discount", "nothing_misleads"),
        ({"bias": -0.85, "gamma": 0.99, "sweeps": 15.0}, "critic_level", "level_immature"),
        ({"bias": -0.85}, "critic_level", "level_biased"),
        ({"bias": 0.1}, "critic_level", "level_right"),
    ],
)
def test_what_is_found_of_a_critic_has_its_verdict_and_a_sentence_with_numbers(
    found, question, reason
):
    measured = diagnosis_of("linear", DEEP).measurements.model_copy(
        update={"critic": report_of(**found)}
    )
    verdict = diagnosed(load_policy("linear", DEEP), measured).verdict(question)
    assert verdict.reason == reason
    assert len(verdict.sentence()) > 20


@pytest.mark.parametrize("question", ["critic_ranking", "critic_outside", "discount"])
def test_a_critic_of_states_rules_nothing_out(question):
    shaped = DEEP.derive(shaping={"scale": 3})
    critic_of_states = {"critic": report_of(ranking=None, outside=None)}
    measured = diagnosis_of("linear", DEEP).measurements.model_copy(update=critic_of_states)
    verdict = diagnosed(load_policy("linear", shaped), measured).verdict(question)
    assert (verdict.answer, verdict.reason) == ("cannot tell", "critic_of_states")


def test_a_diagnosis_of_a_model_has_its_critic_and_draws_it(figures, tmp_path):
    pytest.importorskip("matplotlib")
    spec = SMESpec(**SMALL, shaping={"scale": 3})
    diagnosis = diagnose(load_policy(model(TD3, spec=spec), spec), states=64, episodes=8)
    assert diagnosis.measurements.critic.region("OOD 5").misled_ranking is not None
    assert diagnosis.verdict("critic_level").evidence["gamma"] == 0.9
    draw(diagnosis, tmp_path)
    labels = {axes.get_ylabel() for figure in figures for axes in figure.axes}
    assert "discounted value" in labels
    assert "critic" not in diagnosis_of("linear", DEEP).model_dump()["measurements"]


@pytest.fixture(scope="module")
def iql(tmp_path_factory):
    """The folder of a short training with IQL, which has learnt something, and its task."""
    spec, folder = SMESpec(**SMALL), tmp_path_factory.mktemp("runs") / "iql"
    settings = {"hidden": [32, 32], "discount": 0.0, "learning_rate": 3e-3}
    train_offline(
        transitions_of(spec, nu=1.0, count=4000),
        spec=spec,
        steps=1000,
        evaluations=1,
        folder=folder,
        protocol={"states_per_region": 64},
        hyperparameters=settings,
    )
    return folder, spec


def test_of_iql_only_the_ranking_is_known_from_its_folder_or_its_policy(iql):
    folder, spec = iql
    report = critic(folder, spec, states=200)
    assert (report.algorithm, report.kind, report.gamma) == ("IQL", "Q", 0.0)
    assert (report.sweeps, report.times) == (None, ())
    cube = report.region("WD")
    assert cube.ranking > 0.6
    assert (cube.claim, cube.finite, cube.continuing, cube.bias) == (None,) * 4
    assert critic(folder / "policy.npz", spec, states=200) == report
    with pytest.raises(SMEError, match="trained on"):
        critic(folder, "Default")


def test_critics_are_those_of_the_learner_and_bc_has_none():
    data, about = transitions_of(SMESpec(**SMALL), count=100), {"seed": 0}
    learner = OfflineLearner(IQLHyperparameters(hidden=[8]), data, 32, about)
    learner.advance(3, lambda step: None)
    inputs = np.random.default_rng(0).uniform(-1, 1, (50, 7)).astype(np.float32)
    for learnt, module in zip(learner.critics, learner._networks.critics, strict=True):
        expected = module(torch.from_numpy(inputs)).detach()
        np.testing.assert_allclose(learnt(inputs), expected, rtol=0, atol=1e-6)
        assert learnt.about == {**about, "discount": 0.99}
    assert OfflineLearner(BCHyperparameters(), data, 32, about).critics == []


def test_an_offline_training_is_diagnosed_with_its_critic(iql, figures, tmp_path):
    pytest.importorskip("matplotlib")
    diagnosis = diagnose(load_run(iql[0]), states=64, episodes=8)
    assert diagnosis.plan["algorithm"] == "iql"
    assert diagnosis.measurements.critic.region("visited").ranking is not None
    verdict = diagnosis.verdict("critic_level")
    assert (verdict.answer, verdict.reason) == ("cannot tell", "level_of_data")
    draw(diagnosis, tmp_path)
    labels = {axes.get_ylabel() for figure in figures for axes in figure.axes}
    assert sum("the critic" in label for label in labels) == 1
    assert "discounted value" not in labels
