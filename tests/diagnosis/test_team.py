"""The diagnosis of teams: planted faults are found, and credit adds up."""

import json

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate, load
from sme_registry.diagnosis import Diagnosis, diagnose, load_policy, load_run
from sme_registry.diagnosis.measure import LINEAR, POLICY
from sme_registry.diagnosis.task import TEAM_QUESTIONS, TeamDiagnosis
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.evaluation.references import reference_policy
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.studies import run_study
from sme_registry.studies.subject import load_cell
from tests.commands import good
from tests.diagnosis.policies import printed
from tests.geometry import assert_readable

AGENTS = [
    {"name": "scout_0", "action_dim": 1, "observes": [0, 1]},
    {"name": "driver_0", "action_dim": 2},
    {"name": "driver_1", "action_dim": 2},
]
NAMES = tuple(agent["name"] for agent in AGENTS)
SPEC = SMESpec(horizon=20, state_dim=4, action_dim=5, complexity=3, seed=2, team={"agents": AGENTS})


def half(observation):
    return np.full((len(observation), 2), 0.5)


def with_optimal(spec=SPEC, **others):
    """The optimal team, in which these agents act otherwise."""
    return {**reference_policy("optimal", spec), **others}


def diagnosis_of(policies, spec=SPEC, **options):
    settings = {"states": 1024, "episodes": 8, **options}
    return diagnose(load_policy(policies, spec, name="it"), **settings)


@pytest.fixture(scope="module")
def one_fails():
    """The optimal team, except that driver_1 always takes ½."""
    return diagnosis_of(with_optimal(driver_1=half))


@pytest.fixture(scope="module")
def solved():
    return diagnosis_of(with_optimal())


def answers(diagnosis):
    return {verdict.question: verdict.answer for verdict in diagnosis.verdicts}


def test_the_task_of_a_policy_may_be_a_name():
    team = load_policy(reference_policy("optimal", load("Team2")), "Team2")
    assert team.spec == load("Team2")
    with pytest.raises(UnknownNameError, match="Did you mean"):
        load_policy("optimal", "Teem2")


def test_an_unknown_agent_of_a_team_is_refused(one_fails):
    with pytest.raises(UnknownNameError, match=r"must be 'scout_0', .* Did you mean 'driver_"):
        one_fails.agent("driver_2")


def test_a_team_has_words_for_the_terminal_a_pipe_and_a_notebook_which_runs_no_html(one_fails):
    assert not any(line.startswith("blame") for line in printed(one_fails))  # a sentence, a table
    lines = printed(one_fails, details=True)
    assert any(line.startswith("blame: yes, ") for line in lines)
    assert max(map(len, lines)) <= 100
    start = "driver_1 is to blame for 100% of the regret, with 40% of the action channels: in the "
    assert one_fails.headline().startswith(start)
    assert "| driver_1 |" in one_fails.markdown(["who_agents.png"])
    page = one_fails.model_copy(update={"name": "<script>![i](http://e)"})._repr_markdown_()
    assert page.startswith("# &lt;script>![i]\\(http://e) on ")
    assert "<" not in page
    assert "](" not in page
    assert "scout_0" in page
    for verdict in one_fails.verdicts:
        for reason in TEAM_QUESTIONS[verdict.question].reasons:
            if verdict.question == "ended_episodes" and reason != verdict.reason:
                continue  # other evidence; see the test of episodes that one agent ends
            assert verdict.model_copy(update={"reason": reason}).sentence()


def test_the_agent_that_fails_is_to_blame(one_fails):
    blame = one_fails.verdict("blame")
    assert blame.answer == "yes"
    assert [each["agent"] for each in blame.evidence["blamed"]] == ["driver_1"]
    assert one_fails.verdict("unequal_agents").evidence["worst"] == "driver_1"
    assert one_fails.verdict("one_correction").reason == "one_agent_suffices"
    assert one_fails.verdict("visited_states").answer == "no"
    driver, scout = one_fails.agent("driver_1"), one_fails.agent("scout_0")
    assert driver.level == "no_better_than_constant"
    assert scout.level == "solved"
    assert {v.answer for v in scout.verdicts} == {"no"}
    assert tuple(agent.name for agent in one_fails.agents) == NAMES
    assert (scout.state_channels, scout.action_channels) == ((1, 2), (1,))
    assert one_fails.agent("driver_0").action_channels == (2, 3)


def test_shares_add_up_to_the_teams_regret(one_fails):
    for credit, score in (("uniform", one_fails.uniform), ("visited", one_fails.visited)):
        shares = [getattr(agent, credit).regret_share for agent in one_fails.agents]
        assert sum(shares) == pytest.approx(score.regret)
    credit = one_fails.agent("driver_1").uniform
    assert credit.difference_reward == pytest.approx(one_fails.uniform.regret)


def test_an_agents_numbers_agree_with_evaluate():
    random = reference_policy("random", SPEC)["scout_0"]
    policies = with_optimal(driver_0=half, scout_0=random)
    report = evaluate(policies, SPEC, {"states_per_region": 1024})
    diagnosis = diagnosis_of(policies)
    for name, agent in report.agents.items():
        measured = diagnosis.agent(name).measurements
        assert measured.policy.mae == pytest.approx(agent.regions[0].mae, abs=0.02)
        linear = agent.references["linear"][0].normalised_regret
        found = measured.uniform["linear"].normalised_regret
        assert found == pytest.approx(linear, abs=0.02)


def test_an_optimal_team_is_solved_and_no_one_is_to_blame(solved):
    assert set(answers(solved).values()) == {"no"}
    assert solved.verdict("blame").reason == "solved"
    assert all(agent.level == "solved" for agent in solved.agents)
    assert "sparsity" not in solved.left_out


def test_where_all_agents_fail_no_one_stands_out_and_one_correction_does_not_help():
    def opposite(policy):  # the bound that is further from the optimal action
        return lambda observation: (np.asarray(policy(observation)) < 0.5).astype(float)

    team = {name: opposite(policy) for name, policy in with_optimal().items()}
    found = answers(diagnosis_of(team))
    assert (found["blame"], found["one_correction"]) == ("no", "no")


def test_an_agent_with_a_harder_optimum_is_distinguished(one_fails):
    """The linear policy of an agent whose π* is hardly linear explains its regret."""
    spec = load("DuoDeep")
    verdict = diagnosis_of("linear", spec).verdict("harder_optimum")
    easy = one_fails.verdict("harder_optimum")
    assert easy.answer == "no"
    regrets = [each.evidence["linear_normalised_regret"] for each in (easy, verdict)]
    assert regrets[0] < regrets[1]


@pytest.mark.parametrize(
    ("updates", "learnt", "answer"),
    [(20, 0.79, "yes"), (19, 0.79, "cannot tell"), (None, 0.8, "cannot tell")],
)
def test_a_harder_optimum_is_a_cause_only_of_a_team_that_has_learnt(
    one_fails, updates, learnt, answer
):
    *others, driver = one_fails.agents
    linear = driver.measurements.uniform[LINEAR].model_copy(update={"normalised_regret": 0.9})
    uniform = {**driver.measurements.uniform, LINEAR: linear}
    measurements = driver.measurements.model_copy(update={"uniform": uniform})
    agents = [*others, driver.model_copy(update={"measurements": measurements})]
    visited = one_fails.visited.model_copy(update={"normalised_regret": learnt})
    fields = {"agents": agents, "visited": visited, "updates": updates}
    verdict = one_fails.model_copy(update=fields).judged(TEAM_QUESTIONS).verdict("harder_optimum")
    assert verdict.answer == answer


def test_an_agent_that_fails_only_where_the_team_takes_it():
    policies = with_optimal()

    def in_batches_of_eight(observation):  # the episodes, and no uniform states
        a = policies["driver_1"](observation)
        return np.full_like(a, 0.5) if len(observation) == 8 else a

    verdict = diagnosis_of({**policies, "driver_1": in_batches_of_eight}).verdict("visited_states")
    assert verdict.reason == "worse_where_visited"
    assert verdict.evidence["agent"] == "driver_1"


def test_the_agent_that_ends_the_episodes_is_named():
    spec = SPEC.derive(D=0.25)
    diagnosis = diagnosis_of(with_optimal(spec, driver_0=half), spec, episodes=32)
    ended = diagnosis.verdict("ended_episodes")
    assert (ended.answer, ended.evidence["agent"]) == ("yes", "driver_0")
    assert ended.sentence()
    assert diagnosis.agent("scout_0").measurements.on_policy.termination_rate == 0.0
    assert diagnosis.agent("driver_0").measurements.on_policy.termination_rate > 0.5


def test_the_regret_of_a_shared_reward_is_attributed_to_each_agents_own_actions():
    spec = SPEC.derive(team={"agents": AGENTS, "reward": "team"})
    diagnosis = diagnosis_of(with_optimal(spec, driver_1=half), spec)
    scores = {a.name: a.measurements.on_policy.scores[POLICY] for a in diagnosis.agents}
    assert max(scores["scout_0"].regret, scores["driver_0"].regret) < 1e-6  # float32 states
    assert scores["driver_1"].regret > 0.5
    assert "sparsity" in diagnosis.left_out


def test_a_cell_of_a_study_of_teams_is_diagnosed(tmp_path):
    setting = SPEC.to_dict()
    setting.pop("seed")
    plan = StudyPlan.from_dict(
        {
            "classes": [{"name": "team", "setting": setting, "seeds": [2]}],
            "algorithms": [
                {"name": "linear", "uses": "reference:linear", "steps": 0},
                {"name": "A2C", "uses": "A2C", "steps": 10},
            ],
            "seeds": 1,
            "evaluations": 1,
            "evaluation_episodes": 1,
            "protocol": {"states_per_region": 16},
        }
    )
    file = StudyFile(name="teams", digest=plan.digest, plan=plan)
    run_study(file, tmp_path, executor="in-process")
    learner = next(p.cell for p in plan.cells if p.cell.uses == "A2C").digest
    with pytest.raises(OptionError, match=r"model was not kept.*new folder, with --keep-models"):
        load_cell(tmp_path, learner)
    (tmp_path / "cells" / f"{learner.removeprefix('sha256:')}.json").unlink()
    run_study(file, tmp_path, executor="in-process", keep_models=True)
    cells = [path.stem for path in (tmp_path / "cells").iterdir()]
    assert len(cells) == 2
    for cell in cells:
        subject = load_cell(tmp_path, cell)
        assert len(diagnose(subject, states=64, episodes=8).agents) == 3


def trained(folder, **options):
    """A run of a team in a folder, as `sme train` leaves it."""
    from sme_registry.training import train

    train(
        SPEC, algorithm="PPO", steps=32, folder=folder, num_envs=1,
        hyperparameters={"n_steps": 32, "batch_size": 32, "n_epochs": 1},
        protocol={"states_per_region": 16}, progress=False, **options,
    )  # fmt: skip
    return folder


def test_the_command_diagnoses_a_run_of_a_team(tmp_path, figures):
    run, why = trained(tmp_path / "run"), tmp_path / "why"
    result = good("diagnose", run, "--states", "64", "--episodes", "8", "--out", why)
    assert "driver_1" in result.stdout
    written = Diagnosis.from_dict(json.loads((why / "diagnosis.json").read_text()))
    assert written.spec_digest == SPEC.digest
    assert written.plan["algorithm"] == "PPO"
    assert "who_agents.png" in (why / "diagnosis.md").read_text()
    assert (why / "who_agents.png").exists()
    assert_readable(figures[-1])  # the others are those of the training


def test_a_run_of_independent_agents_is_diagnosed(tmp_path):
    diagnosis = diagnose(load_run(trained(tmp_path, independent=True)), states=64, episodes=8)
    assert isinstance(diagnosis, TeamDiagnosis)
    assert tuple(agent.name for agent in diagnosis.agents) == NAMES
