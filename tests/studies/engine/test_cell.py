"""A study's cell: what it trains is what SB3 alone would, and what it says of it is exact."""

import sys
import tempfile

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.datasets import DatasetRecipe
from sme_registry.datasets.collect import collect
from sme_registry.errors import (
    MissingDependencyError,
    OptionError,
    PolicyError,
    SpecError,
)
from sme_registry.spec import EvaluationProtocol
from sme_registry.studies.cell import run_cell
from sme_registry.studies.result import CellResult
from sme_registry.task import materialize
from tests.studies.cells import cell_of

SPEC = SMESpec(state_dim=2, action_dim=2, horizon=20)


def cell(uses="TD3", **changes):
    fields = {
        "spec": SPEC, "uses": uses, "steps": 130, "evaluations": 4,
        "protocol": {"states_per_region": 100},
    }  # fmt: skip
    return cell_of(**fields | changes)


def without_timing(result):
    return {field: value for field, value in result.to_dict().items() if field != "timing"}


class Searcher:
    """A learner of another make: keeps the constant action that paid most on one try."""

    def __init__(self, env, seed, spread):
        self.env, self.spread = env, spread
        self.generator = np.random.default_rng(seed)
        self.best, self.action = -1.0, np.zeros(env.action_space.shape, np.float32)

    def learn(self, total_timesteps):
        self.env.reset()
        for _ in range(total_timesteps):
            tried = self.generator.uniform(-self.spread, self.spread, self.action.shape)
            reward = float(self.env.step(tried[None])[1][0])
            if reward > self.best:
                self.best, self.action = reward, tried.astype(np.float32)

    def predict(self, observation, *, deterministic):
        assert deterministic
        return np.tile(self.action, (len(observation), 1))


class Idler(Searcher):
    def learn(self, total_timesteps):
        super().learn(total_timesteps // 2)


def search(env, *, seed, spread=1.0):
    return Searcher(env, seed, spread)


def idle(env, *, seed):
    return Idler(env, seed, 1.0)


@pytest.fixture(scope="module")
def td3(tmp_path_factory):
    pytest.importorskip("stable_baselines3")
    path = tmp_path_factory.mktemp("models") / "model.zip"
    return run_cell(cell(), model_path=path), path


def test_the_same_cell_gives_the_same_result_which_survives_its_file(td3):
    result = td3[0]
    assert without_timing(run_cell(cell())) == without_timing(result)
    assert without_timing(run_cell(cell(seed=4))) != without_timing(result)
    assert CellResult.from_dict(result.to_dict()) == result
    assert (result.key, result.cell) == (cell().digest, cell())
    assert {"torch", "stable_baselines3", "sme_registry"} <= result.versions.keys()


def test_it_learns_what_sb3_alone_would_learn(td3):
    from stable_baselines3 import TD3
    from stable_baselines3.common.callbacks import BaseCallback

    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training.algorithms import one_thread

    regrets = []

    class Listen(BaseCallback):  # type: ignore[misc, unused-ignore]
        def _on_step(self):
            regrets.extend(info["regret"] for info in self.locals["infos"])
            return True

    with one_thread():
        alone = TD3("MlpPolicy", SMEVecEnv(SPEC), seed=3, device="cpu").learn(130, Listen())
    result, path = td3
    kept = TD3.load(path, device="cpu")
    for ours, theirs in zip(kept.policy.parameters(), alone.policy.parameters(), strict=True):
        assert bool((ours == theirs).all())
    assert result.online_regret == pytest.approx(np.mean(regrets), abs=1e-12)


def test_evaluating_changes_nothing_of_the_training(td3):
    silent = run_cell(cell(evaluations=0))
    assert silent.curve.steps == ()
    assert silent.online_regret == td3[0].online_regret
    assert silent.report == td3[0].report


def test_evaluations_are_evenly_spaced_and_the_last_is_at_the_end(td3):
    curve = td3[0].curve
    assert curve.steps == (32, 65, 98, 130)
    assert {len(column) for column in curve.to_dict().values()} == {4}
    assert all(0 <= value <= 20 for value in curve.episode_return)
    assert curve.length == (20.0,) * 4
    for returned, regret in zip(curve.episode_return, curve.regret, strict=True):
        assert returned == pytest.approx(20 * (1 - regret))


def test_on_policy_training_ends_with_its_last_rollout():
    result = run_cell(cell("PPO", steps=90, hyperparameters={"n_steps": 50, "batch_size": 25}))
    assert result.curve.steps == (22, 45, 68, 100)
    assert result.report.policy == "PPO"


def test_evaluations_are_made_with_fewer_steps_and_without_any():
    assert run_cell(cell(steps=2, evaluations=5)).curve.steps == (0, 1, 1, 2, 2)
    untrained = run_cell(cell(steps=0, evaluations=2))
    assert untrained.curve.steps == (0, 0)
    assert untrained.online_regret is None
    assert untrained.timing.steps_per_second == 0.0


def test_seconds_add_up(td3):
    timing = td3[0].timing
    parts = timing.training, timing.environment, timing.evaluation
    assert min(parts) > 0.0
    assert sum(parts) == pytest.approx(timing.total)
    learning = timing.training + timing.environment
    assert timing.steps_per_second == pytest.approx(130 / learning)


def test_progress_is_reported_after_each_step():
    reports = []
    run_cell(cell("PPO", hyperparameters={"n_steps": 50}), lambda *now: reports.append(now))
    assert reports == [(done, 130) for done in range(131)]


def test_nothing_is_written_that_was_not_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    run_cell(cell(steps=20))
    assert list(tmp_path.iterdir()) == []


def test_the_unit_action_range_is_trained_in_and_recorded():
    unit, symmetric = (
        run_cell(cell("PPO", action_range=range_, steps=32, hyperparameters={"n_steps": 32}))
        for range_ in ("unit", "symmetric")
    )
    assert (unit.report.action_range, symmetric.report.action_range) == ("unit", "symmetric")
    # An untrained Gaussian's mean is 0: an end of the one range, and the middle of the other.
    assert unit.report.regions[0].normalised_regret > 1.5
    assert symmetric.report.regions[0].normalised_regret == pytest.approx(1.0, abs=0.1)


def test_a_learner_of_another_make_is_evaluated_when_it_is_due():
    uses = "tests.studies.engine.test_cell:search"
    result = run_cell(cell(uses, hyperparameters={"spread": 0.5}))
    assert result.curve.steps == (32, 65, 98, 130)
    assert 0.0 < (result.online_regret or 0.0) < 1.0
    # A constant action: its return no longer changes once the best try is found.
    assert result.report.regions[0].similarity > 0.6
    with pytest.raises(PolicyError, match="returned after 65 steps"):
        run_cell(cell("tests.studies.engine.test_cell:idle"))


def test_a_reference_is_judged_as_often_as_a_learner_would_be():
    result = run_cell(cell("reference:optimal"))
    assert result.curve.steps == (32, 65, 98, 130)
    assert result.curve.regret == pytest.approx((0,) * 4, abs=1e-6)
    assert result.online_regret is None
    assert result.timing.training == 0.0
    constant = run_cell(cell("reference:constant"))
    assert len(set(constant.curve.episode_return)) == 4
    assert constant.curve != run_cell(cell("reference:constant", seed=4)).curve
    assert constant.report.regions[0].normalised_regret == pytest.approx(1.0)


def test_what_cannot_be_run_is_refused():
    team = SPEC.derive(team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
    with pytest.raises(SpecError, match="algorithm='offline:bc': learns a task of a single agent"):
        run_cell(cell("offline:bc", spec=team))
    with pytest.raises(OptionError, match="degree: reference:linear has no such hyperparameter"):
        run_cell(cell("reference:linear", hyperparameters={"degree": 2}))
    with pytest.raises(OptionError, match=r"nu=1.5: must be in \[0, 1\]"):
        run_cell(offline(nu=1.5))
    with pytest.raises(SpecError, match="D"):
        run_cell(offline(spec=SMESpec(state_dim=2, action_dim=1, D=0.1)))


def test_without_sb3_a_reference_runs_and_a_learner_says_what_to_install(monkeypatch):
    for package in ("stable_baselines3", "torch"):  # as if they were not installed
        monkeypatch.setitem(sys.modules, package, None)
    assert run_cell(cell("reference:linear")).online_regret is None
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[train\]"):
        run_cell(cell("PPO"))


# Cells that learn from data

OFFLINE_PROTOCOL = EvaluationProtocol(states_per_region=50)


def offline(uses="offline:bc", spec=None, **hyperparameters):
    return cell_of(
        spec=spec or SMESpec(state_dim=2, action_dim=1, seed=1),
        uses=uses,
        hyperparameters={"nu": 0.5, "transitions": 1000, **hyperparameters},
        action_range="unit",
        steps=60,
        evaluations=2,
        evaluation_episodes=2,
        protocol=OFFLINE_PROTOCOL,
    )


@pytest.mark.parametrize("learner", ["bc", "iql"])
def test_a_cell_learns_from_the_data_of_its_seed_and_is_judged_as_every_cell(learner):
    done = run_cell(offline(f"offline:{learner}"))
    assert done.curve.steps == (30, 60)
    assert done.online_regret is None
    assert done.report.protocol == OFFLINE_PROTOCOL
    recipe = DatasetRecipe.from_dict(
        {
            "spec": done.cell.spec,
            "behaviours": [{"kind": "mixture", "nu": 0.5, "weight": 1.0}],
            "transitions": 1000,
            "seed": 3,
            "protocol": OFFLINE_PROTOCOL,
        }
    )
    data = collect(recipe, materialize(done.cell.spec), {})
    assert done.offline.dataset_digest == data.digest
    assert done.offline.behaviour_similarity == float(data.similarities.mean())
    assert done.offline.similarity == done.curve.similarity[-1]
    again = run_cell(offline(f"offline:{learner}"))
    assert (again.curve, again.report, again.offline) == (done.curve, done.report, done.offline)


def test_the_regret_of_an_offline_cell_is_exact_where_returns_are_shaped():
    plain = SMESpec(state_dim=2, action_dim=1, seed=1)
    curves = [  # of the same clone: of rewards it learns nothing
        run_cell(offline(spec=spec)).curve for spec in (plain, plain.derive(shaping={"scale": 9.0}))
    ]
    assert curves[0].regret == curves[1].regret
    assert curves[0].episode_return != pytest.approx(curves[1].episode_return)


@pytest.mark.parametrize("uses", ["offline:bc", "PPO"])
def test_cells_have_limits_and_distractors_and_repeat_to_the_bit(uses):
    observed = {"distractors": 3, "mixing": "orthogonal"}
    spec = SMESpec(state_dim=2, action_dim=1, horizon=20, seed=1).derive(
        safety={"tightness": 0.2}, observation=observed
    )
    own = {} if uses == "PPO" else {"hyperparameters": {"nu": 0.5, "transitions": 500}}
    plain = offline(uses, spec=spec).model_copy(update={"hyperparameters": {}, **own})
    done, again = run_cell(plain), run_cell(plain)
    assert (again.curve, again.report) == (done.curve, done.report)
    assert done.report.safety is not None
    assert done.report.observation is not None
