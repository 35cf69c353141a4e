"""Cells that learn from data: the same machinery, and what they add."""

from __future__ import annotations

import pytest

from sme_registry.datasets import DatasetRecipe
from sme_registry.datasets.collect import collect
from sme_registry.errors import OptionError, SpecError, UnknownNameError
from sme_registry.spec import Cell, EvaluationProtocol, SMESpec
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.checks import check_task
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.runner import run_study
from sme_registry.task import materialize
from tests.studies.cells import small_file

PROTOCOL = EvaluationProtocol(states_per_region=50)


def cell(uses: str = "offline:bc", spec: SMESpec | None = None, **hyperparameters: object) -> Cell:
    return Cell(
        spec=spec or SMESpec(state_dim=2, action_dim=1, seed=1),
        uses=uses,
        hyperparameters={"nu": 0.5, "transitions": 1000, **hyperparameters},
        action_range="unit",
        seed=3,
        steps=60,
        evaluations=2,
        evaluation_episodes=2,
        protocol=PROTOCOL,
    )


@pytest.mark.parametrize("learner", ["bc", "iql"])
def test_a_cell_learns_from_the_data_of_its_seed_and_is_judged_as_every_cell(learner: str) -> None:
    done = run_cell(cell(f"offline:{learner}"))
    assert done.curve.steps == (30, 60)
    assert done.online_regret is None
    assert done.report.protocol == PROTOCOL
    assert done.offline is not None
    recipe = DatasetRecipe.from_dict(
        {
            "spec": done.cell.spec,
            "behaviours": [{"kind": "mixture", "nu": 0.5, "weight": 1.0}],
            "transitions": 1000,
            "seed": 3,
            "protocol": PROTOCOL,
        }
    )
    data = collect(recipe, materialize(done.cell.spec), {})
    assert done.offline.dataset_digest == data.digest
    assert done.offline.behaviour_similarity == float(data.similarities.mean())
    assert done.offline.similarity == done.curve.similarity[-1]
    again = run_cell(cell(f"offline:{learner}"))
    assert (again.curve, again.report, again.offline) == (done.curve, done.report, done.offline)


@pytest.mark.parametrize("uses", ["offline:bc", "PPO"])
def test_cells_have_limits_and_distractors_and_repeat_to_the_bit(uses: str) -> None:
    observed = {"distractors": 3, "mixing": "orthogonal"}
    spec = SMESpec(state_dim=2, action_dim=1, horizon=20, seed=1).derive(
        safety={"tightness": 0.2}, observation=observed
    )
    own = {} if uses == "PPO" else {"hyperparameters": {"nu": 0.5, "transitions": 500}}
    plain = cell(uses, spec=spec).model_copy(update={"hyperparameters": {}, **own})
    done, again = run_cell(plain), run_cell(plain)
    assert (again.curve, again.report) == (done.curve, done.report)
    assert done.report is not None
    assert done.report.safety is not None
    assert done.report.observation is not None


def test_more_noise_makes_worse_data_and_other_cells() -> None:
    noisy, clean = run_cell(cell(nu=1.0)), run_cell(cell(nu=0.0))
    assert noisy.key != clean.key
    assert noisy.offline is not None
    assert clean.offline is not None
    assert clean.offline.behaviour_similarity == pytest.approx(1.0)
    assert noisy.offline.behaviour_similarity < 0.97


def test_bad_cells_are_refused_in_words() -> None:
    spec = SMESpec(state_dim=2, action_dim=1)
    check_task(cell("jax:PPO", spec=spec.derive(safety={"tightness": 0.2})))
    team = spec.derive(team={"agents": [{"name": "agent_0", "action_dim": 1}]})
    with pytest.raises(SpecError, match="uses='jax:PPO': cannot learn a task for 1 agents"):
        cell("jax:PPO", spec=team)
    with pytest.raises(UnknownNameError, match="offline:iql"):
        run_cell(cell("offline:iq"))
    with pytest.raises(OptionError, match="nu"):
        run_cell(cell().model_copy(update={"hyperparameters": {}}))
    with pytest.raises(SpecError, match="nu"):
        run_cell(cell(nu=1.5))
    with pytest.raises(SpecError, match="D"):
        run_cell(cell(spec=SMESpec(state_dim=2, action_dim=1, D=0.1)))


def test_a_study_runs_offline_cells_as_it_runs_others(tmp_path) -> None:
    learner = {"name": "BC (0.5)", "uses": "offline:bc", "action_range": "unit",
               "hyperparameters": {"nu": 0.5, "transitions": 500}}  # fmt: skip
    file = small_file(seeds=1, algorithms=[learner], steps=20, evaluations=1)
    run_study(file, tmp_path / "study", executor="in-process")
    result = Ledger(tmp_path / "study").result(file.plan.cells[0].cell.digest)
    assert result is not None
    assert result.offline is not None
