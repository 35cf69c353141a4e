"""The diagnosis of teams: planted faults are found, and credit adds up."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sme_registry import SMESpec, evaluate, load, materialize
from sme_registry.cli import app
from sme_registry.diagnosis import (
    TeamDiagnosis,
    TeamSubject,
    diagnose,
    load_cell,
    load_policy,
    load_run,
)
from sme_registry.diagnosis.measurements import POLICY
from sme_registry.diagnosis.team_questions import TEAM_QUESTIONS, TEAM_THRESHOLDS
from sme_registry.diagnosis.team_render import headline, markdown, team_sentence, terminal
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.evaluation.references import reference_policy
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.studies import run_study
from tests.diagnosis.policies import printed

SPEC = SMESpec(
    horizon=20,
    state_dim=4,
    action_dim=5,
    complexity=3,
    seed=2,
    team={
        "agents": [
            {"name": "scout_0", "action_dim": 1, "observes": [0, 1]},
            {"name": "driver_0", "action_dim": 2},
            {"name": "driver_1", "action_dim": 2},
        ]
    },
)


def optimal(spec: SMESpec = SPEC) -> dict[str, Any]:
    return dict(reference_policy("optimal", spec))  # type: ignore[arg-type]


def half(width: int) -> Any:
    return lambda observation: np.full((len(observation), width), 0.5)


def opposite(policy: Any) -> Any:
    """The bound that is further from the optimal action."""
    return lambda observation: (np.asarray(policy(observation)) < 0.5).astype(float)


def diagnosis_of(policies: dict[str, Any], spec: SMESpec = SPEC, **options: Any) -> TeamDiagnosis:
    settings = {"states": 1024, "episodes": 8, **options}
    result = diagnose(load_policy(policies, spec, name="it"), **settings)
    assert isinstance(result, TeamDiagnosis)
    return result


@pytest.fixture(scope="module")
def one_fails() -> TeamDiagnosis:
    """The optimal team, except that driver_1 always takes ½."""
    return diagnosis_of({**optimal(), "driver_1": half(2)})


def answers(diagnosis: TeamDiagnosis) -> dict[str, str]:
    return {verdict.question: verdict.answer for verdict in diagnosis.verdicts}


def test_an_unknown_question_or_agent_of_a_team_is_refused(one_fails: TeamDiagnosis) -> None:
    assert one_fails.verdict("unequal agents") is one_fails.verdict("unequal_agents")
    with pytest.raises(UnknownNameError, match="Did you mean 'blame'"):
        one_fails.verdict("blam")
    with pytest.raises(UnknownNameError, match=r"must be one of scout_0, .* Did you mean 'driver_"):
        one_fails.agent("driver_2")


def test_a_team_in_a_pipe_has_short_lines(one_fails: TeamDiagnosis) -> None:
    lines = printed(terminal(one_fails), None)
    assert "blame: yes" in lines
    assert max(map(len, lines)) <= 100


def test_a_notebook_shows_the_page_of_a_team_and_runs_no_html(one_fails: TeamDiagnosis) -> None:
    page = one_fails.model_copy(update={"name": "<script>![i](http://e)"})._repr_markdown_()
    assert page.startswith("# &lt;script>![i]\\(http://e) on ")
    assert "<" not in page
    assert "](" not in page
    assert one_fails.agents[0].name in page


def test_the_agent_that_fails_is_to_blame(one_fails: TeamDiagnosis) -> None:
    blame = one_fails.verdict("blame")
    assert blame.answer == "yes"
    assert [each["agent"] for each in blame.evidence["blamed"]] == ["driver_1"]  # type: ignore[index, union-attr, call-overload]
    assert one_fails.verdict("unequal_agents").evidence["worst"] == "driver_1"
    assert one_fails.verdict("one_correction").reason == "one_agent_suffices"
    assert one_fails.verdict("visited_states").answer == "no"
    driver, scout = one_fails.agent("driver_1"), one_fails.agent("scout_0")
    assert driver.level == "no_better_than_constant"
    assert scout.level == "solved"
    assert {v.answer for v in scout.verdicts} == {"no"}


def test_shares_add_up_to_the_teams_regret_and_agree_with_the_task(
    one_fails: TeamDiagnosis,
) -> None:
    for credit, score in (("uniform", one_fails.uniform), ("visited", one_fails.visited)):
        shares = [getattr(agent, credit).regret_share for agent in one_fails.agents]
        assert sum(shares) == pytest.approx(score.regret)
    assert one_fails.agent("driver_1").uniform.difference_reward == pytest.approx(
        one_fails.uniform.regret
    )


def test_an_agents_numbers_agree_with_evaluate() -> None:
    policies = {
        **optimal(),
        "driver_0": half(2),
        "scout_0": reference_policy("random", SPEC)["scout_0"],
    }  # type: ignore[index]
    report = evaluate(policies, SPEC, {"states_per_region": 1024})
    diagnosis = diagnosis_of(policies)
    for name, agent in report.agents.items():
        measured = diagnosis.agent(name).measurements
        assert measured.policy.mae == pytest.approx(agent.regions[0].mae, abs=0.02)
        linear = agent.references["linear_least_squares"][0].normalised_regret
        assert measured.uniform["linear_least_squares"].normalised_regret == pytest.approx(
            linear, abs=0.02
        )


def test_an_optimal_team_is_solved_and_no_one_is_to_blame() -> None:
    diagnosis = diagnosis_of(optimal())
    assert set(answers(diagnosis).values()) == {"no"}
    assert diagnosis.verdict("blame").reason == "solved"
    assert all(agent.level == "solved" for agent in diagnosis.agents)


def test_where_all_agents_fail_no_one_stands_out_and_one_correction_does_not_help() -> None:
    team = {name: opposite(policy) for name, policy in optimal().items()}
    found = answers(diagnosis_of(team))
    assert (found["blame"], found["one_correction"]) == ("no", "no")


def test_an_agent_with_a_harder_optimum_is_distinguished() -> None:
    """The linear policy of an agent whose π* is hardly linear explains its regret."""
    spec = load("DuoDeep")
    linear = dict(reference_policy("linear", spec))  # type: ignore[arg-type]
    verdict = diagnosis_of(linear, spec).verdict("harder_optimum")
    easy = diagnosis_of({**optimal(), "driver_1": half(2)}).verdict("harder_optimum")
    assert easy.answer == "no"
    assert verdict.evidence["linear_normalised_regret"] > easy.evidence["linear_normalised_regret"]  # type: ignore[operator]


def test_an_agent_that_fails_only_where_the_team_takes_it() -> None:
    policies = optimal()

    def in_batches_of_eight(observation: Any) -> Any:  # the episodes, and no uniform states
        a = policies["driver_1"](observation)
        return np.full_like(a, 0.5) if len(observation) == 8 else a

    diagnosis = diagnosis_of({**policies, "driver_1": in_batches_of_eight})
    assert diagnosis.verdict("visited_states").reason == "worse_where_visited"
    assert diagnosis.verdict("visited_states").evidence["agent"] == "driver_1"


def test_the_agent_that_ends_the_episodes_is_named() -> None:
    spec = SPEC.derive(D=0.25)
    diagnosis = diagnosis_of({**optimal(spec), "driver_0": half(2)}, spec, episodes=32)
    ended = diagnosis.verdict("ended_episodes")
    assert (ended.answer, ended.evidence["agent"]) == ("yes", "driver_0")
    assert diagnosis.agent("scout_0").measurements.on_policy.termination_rate == 0.0
    assert diagnosis.agent("driver_0").measurements.on_policy.termination_rate > 0.5


def test_the_regret_of_a_shared_reward_is_attributed_to_each_agents_own_actions() -> None:
    team = SPEC.to_dict()["team"] | {"reward": "team"}
    spec = SPEC.derive(team=team)
    diagnosis = diagnosis_of({**optimal(spec), "driver_1": half(2)}, spec)
    scores = {a.name: a.measurements.on_policy.scores[POLICY] for a in diagnosis.agents}
    assert max(scores["scout_0"].regret, scores["driver_0"].regret) < 1e-6  # float32 states
    assert scores["driver_1"].regret > 0.5
    assert "sparsity" in diagnosis.left_out
    assert "sparsity" not in diagnosis_of(optimal()).left_out


def test_episodes_are_those_of_the_environment(one_fails: TeamDiagnosis) -> None:
    """Regret in the team's own states, from the task's own functions."""
    task = materialize(SPEC)
    assert one_fails.visited.regret == pytest.approx(
        sum(agent.visited.regret_share for agent in one_fails.agents)
    )
    assert task.names == tuple(agent.name for agent in one_fails.agents)
    assert one_fails.agent("scout_0").state_channels == (1, 2)
    assert one_fails.agent("driver_0").action_channels == (2, 3)


def test_every_reason_of_every_question_has_words(one_fails: TeamDiagnosis) -> None:
    for verdict in one_fails.verdicts:
        used = dict.fromkeys(verdict.thresholds, 0.5) | TEAM_THRESHOLDS
        for reason in TEAM_QUESTIONS[verdict.question].reasons:
            if verdict.question == "ended_episodes" and reason != verdict.reason:
                continue  # other evidence; see the test of episodes that one agent ends
            other = verdict.model_copy(update={"reason": reason, "thresholds": used})
            assert team_sentence(other)
    assert "driver_1" in headline(one_fails)
    assert "| driver_1 |" in markdown(one_fails, ["who_agents.png"])


def test_a_cell_of_a_study_of_teams_is_diagnosed(tmp_path: Any) -> None:
    setting = SPEC.to_dict()
    setting.pop("seed")
    algorithms = [
        {"name": name, "uses": uses, "steps": steps}
        for name, uses, steps in (("linear", "reference:linear", 0), ("A2C", "A2C", 10))
    ]
    fields = {
        "classes": [{"name": "team", "setting": setting, "seeds": [2]}],
        "algorithms": algorithms,
        "seeds": 1,
        "evaluations": 1,
        "evaluation_episodes": 1,
        "protocol": {"states_per_region": 16},
    }
    plan = StudyPlan.from_dict(fields)
    file = StudyFile(name="teams", digest=plan.digest, plan=plan)
    run_study(file, tmp_path / "study", executor="in-process", keep_models=True)
    for path in (tmp_path / "study" / "cells").iterdir():
        subject = load_cell(tmp_path / "study", path.stem)
        assert isinstance(subject, TeamSubject)
        diagnosis = diagnose(subject, states=128, episodes=8)
        assert len(diagnosis.agents) == 3


def test_comparisons_and_probes_are_refused_for_teams() -> None:
    subject = load_policy(optimal(), SPEC)
    for options in ({"against": subject}, {"probe_capacity": True}):
        with pytest.raises(OptionError, match="single agents on one task only"):
            diagnose(subject, **options)  # type: ignore[arg-type]


def test_the_command_diagnoses_a_run_of_a_team(tmp_path: Any, monkeypatch: Any) -> None:
    from sme_registry.training import train

    monkeypatch.chdir(tmp_path)
    train(
        SPEC, algorithm="PPO", steps=64, folder="run", num_envs=1,
        protocol={"states_per_region": 16}, progress=False,
    )  # fmt: skip
    command = ["diagnose", "run", "--states", "128", "--episodes", "8", "--out", "why"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "driver_1" in result.stdout
    written = TeamDiagnosis.from_dict(json.loads((tmp_path / "why/diagnosis.json").read_text()))
    assert written.spec_digest == SPEC.digest
    assert written.plan["algorithm"] == "PPO"
    assert "who_agents.png" in (tmp_path / "why/diagnosis.md").read_text()
    assert (tmp_path / "why/who_agents.png").stat().st_size > 1000
    assert load_run("run").spec.team is not None

    train(
        SPEC, algorithm="PPO", steps=64, folder="each", num_envs=1, independent=True,
        protocol={"states_per_region": 16}, progress=False,
    )  # fmt: skip
    independent = diagnose(load_run("each"), states=128, episodes=8)
    assert isinstance(independent, TeamDiagnosis)
    assert [agent.name for agent in independent.agents] == ["scout_0", "driver_0", "driver_1"]
