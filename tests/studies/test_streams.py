"""Suites and plans with streams, by command: what they hold, what they run, who refuses them."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app as leaderboard
from sme_registry import SMESpec, StreamSpec, load, save
from sme_registry.errors import SpecError
from sme_registry.spec import StreamFile, StudyFile, StudyPlan, SuiteFile, catalogue
from sme_registry.spec.study import Cell
from sme_registry.studies.budget import uneven_rollouts
from tests import commands

TASK = SMESpec(state_dim=2, action_dim=2, horizon=8)
STREAM = StreamSpec(
    phases=[{"spec": TASK, "steps": 40}, {"spec": TASK.derive(seed=1), "steps": 24}], cycles=2
)


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    save(STREAM, "mine.json")


def good(*arguments):
    return commands.good(*arguments).stdout


def refused(*arguments):
    message = commands.refused(*arguments)
    assert len(message.splitlines()) == 1
    return message


def new_suite(*others):
    good("new", "lives.json", "-t", "mine.json", "--instances", "3", *others)
    return SuiteFile.read("lives.json").suite


def new_plan(*arguments):
    good("study", "new", "plan.json", "--force", *arguments)
    return StudyFile.read("plan.json")


def test_the_suite_of_the_catalogue_has_ten_draws_of_each_of_its_streams():
    suite = catalogue.find(SuiteFile, "continual").suite
    streams = {file.name: file.stream for file in catalogue.entries(StreamFile)}
    assert not suite.classes
    assert {member.name: member.stream for member in suite.streams} == streams
    assert suite.runs == dict.fromkeys(streams, 10)
    assert len({stream.digest for stream in suite.documents.values()}) == 60


def test_a_suite_has_a_class_for_a_stream_beside_tasks():
    suite = new_suite("-t", "Default")
    assert suite.streams[0].instances == tuple(STREAM.draw(number) for number in range(3))
    assert [member.name for member in suite.classes] == ["Default"]
    assert suite.runs == {"Default": 3, "mine": 3}
    wider = commands.good("new", "wider.json", "--suite", "lives.json", "-t", "Switch5")
    assert "3 classes, 7 instances" in wider.stderr
    members = SuiteFile.read("wider.json").suite.streams
    assert [member.name for member in members] == ["mine", "Switch5"]
    good("check", "lives.json", "wider.json", "--files-only")
    assert "appears twice" in refused("new", "x.json", "-t", "mine.json", "-t", "mine.json")


def test_a_suite_of_streams_is_shown_with_names_to_train_by():
    shown = good("show", "continual")
    assert "Cycle2" in shown
    assert "120,000" in shown
    assert "To train on a stream: sme train sha256:" in shown
    lines = good("show", "continual", "--digests").split()
    instances = [*catalogue.find(SuiteFile, "continual").suite.documents.values()]
    assert lines == [stream.digest for stream in instances]
    assert load(lines[1], StreamSpec) == instances[1]
    new_suite("-t", "Default")
    entries = json.loads(good("show", "lives.json", "--json"))["derived"]["instances"]
    assert entries[-1] == {"class": "mine", "draw": 2, "digest": STREAM.draw(2).digest}
    assert "To train on these tasks: sme study new" in good("show", "lives.json")
    listed = good("list", "--kind", "suite").splitlines()
    (line,) = (line for line in listed if line.startswith("continual"))
    assert line.split()[1:4] == ["6", "0", "60"]


def test_every_task_and_every_phase_of_every_draw_is_certified():
    save(TASK, "task.json")
    new_suite("-t", "task.json")
    certified = json.loads(good("check", "lives.json", "--json"))[0]["certificates"]
    phases = [f"lives/mine draw {draw} phase {phase}" for draw in range(3) for phase in (0, 1)]
    tasks = [f"lives/task seed {seed}" for seed in range(3)]
    assert [entry["task"] for entry in certified] == tasks + phases


def test_a_plan_has_a_life_and_fresh_agents_for_each_run():
    arguments = ("--instances", "2", "-a", "TD3", "--seeds", "2", "--evaluations", "12")
    plan = new_plan("-t", "mine.json", *arguments).plan
    assert not plan.classes
    places = [
        (place.run, place.phase, place.cell.steps, place.cell.evaluations) for place in plan.cells
    ]
    of_a_run = [(None, 128, 12), (0, 40, 10), (1, 24, 10)]
    assert places == [(run, *each) for run in (0, 1) for each in of_a_run]
    assert plan.cells[3].cell.stream == STREAM.draw(1)
    assert plan.cells[5].cell == plan.cells[3].cell.fresh[1]
    from_suite = new_plan("--suite", "continual", "-a", "TD3").plan
    assert from_suite.streams == catalogue.find(SuiteFile, "continual").suite.streams


def test_a_life_that_is_a_fresh_agent_itself_has_none():
    drift = {"rotation": 1.0, "increments": 2}
    alone = StreamSpec(phases=[{"spec": TASK, "steps": 40, "drift": drift}])
    twice = StreamSpec(phases=alone.phases, cycles=2)
    save(alone, "alone.json")
    save(twice, "twice.json")
    plan = new_plan("-t", "alone.json", "-t", "twice.json", "-a", "TD3", "--seeds", "1").plan
    found = [(place.class_name, place.phase, place.cell.stream) for place in plan.cells]
    assert found == [("alone", None, alone), ("twice", None, twice), ("twice", 0, alone)]


def test_cells_that_streams_share_count_once():
    file = catalogue.find(StudyFile, "continual")
    assert len(file.plan.cells) == 135
    entry = json.loads(good("study", "plan", "continual", "--json"))
    assert entry["cells"] == 108
    assert "20,000 to 120,000" in good("study", "plan", "continual")
    listed = good("list", "--kind", "study").splitlines()
    assert any("continual-v1" in line and " 108 " in line for line in listed)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-n", "100"), "steps=100: lives have the steps of their streams"),
        (("--sweep", "k=1,2"), "--sweep: varies a field of a task, and 'mine' is a stream"),
        (
            ("-a", "offline:bc"),
            "offline:bc': learns a task of a single agent, and this is a stream",
        ),
        (
            ("-a", "independent:PPO"),
            "independent:PPO': learns the task of a team, and this is a",
        ),
        (("--instances", "0"), "instances=0: must be"),
    ],
)
def test_what_a_plan_of_streams_cannot_have_is_refused(arguments, message):
    assert message in refused(
        "study", "new", "plan.json", "-t", "mine.json", "-a", "TD3", *arguments
    )
    assert not Path("plan.json").exists()


def test_steps_are_those_of_single_tasks_beside_streams():
    tasks = ("-t", "Default", "-t", "mine.json")
    plan = new_plan(*tasks, "-a", "TD3", "-n", "77", "--seeds", "1").plan
    assert [place.cell.steps for place in plan.cells] == [77, 128, 40, 24]


def test_rollouts_that_do_not_end_where_phases_do_are_named_with_a_better_length():
    chosen = ("-a", "PPO", "-a", "TD3", "-a", "short=PPO", "--set", "short.n_steps=8")
    chosen += ("--set", "short.batch_size=8")
    tasks = ("-t", "mine.json", "-t", "Switch5")
    result = commands.good("study", "new", "plan.json", *tasks, *chosen)
    plan = StudyFile.read("plan.json").plan
    (warning,) = uneven_rollouts(plan)
    assert warning.startswith("PPO on mine, Switch5: its rollouts of 2,048 steps")
    assert "uneven rollouts: PPO on mine, Switch5: its rollouts of 2,048 steps" in result.stderr
    assert "--set PPO.n_steps=8" in result.stderr
    assert uneven_rollouts(catalogue.find(StudyFile, "continual").plan) == []


def test_the_better_length_suits_every_stream():
    twelve = StreamSpec(phases=[{"spec": STREAM.phases[0].spec, "steps": 12}] * 2)
    save(twelve, "twelve.json")
    chosen = ("-a", "PPO", "--set", "PPO.n_steps=8", "--set", "PPO.batch_size=4")
    plan = new_plan("-t", "mine.json", "-t", "twelve.json", *chosen).plan
    (warning,) = uneven_rollouts(plan)
    assert warning.startswith("PPO on twelve: ")
    assert "n_steps=4," in warning  # 6 would suit twelve alone


def test_a_suite_of_streams_is_trained_on_for_the_steps_of_its_streams():
    new_suite()
    message = refused("train", "--suite", "lives.json", "-n", "100")
    assert "--steps: is that of each stream here. Leave it out" in message
    message = refused("train", "--suite", "lives.json", "-a", "TD3", "--device", "cpu")
    assert "device='cpu': is for agents in JAX" in message  # the plan was accepted
    assert "and this is a stream" in refused("train", "--suite", "lives.json", "--independent")


def test_leaderboards_refuse_streams():
    new_suite()
    result = CliRunner().invoke(leaderboard, ["init", "board", "--suite", "lives.json"])
    assert result.exit_code == 2, result.output
    assert "suite: has streams (mine)" in result.stderr


def test_a_plan_with_a_life_of_more_visits_than_are_evaluated_is_refused():
    stream = StreamSpec(phases=STREAM.phases, cycles=501)
    fields = new_plan("-t", "mine.json", "-a", "TD3").plan.to_dict()
    fields["streams"].append({"name": "long", "stream": stream.to_dict()})
    with pytest.raises(SpecError, match=r"streams.1.stream: cycles × phases=1,002: .* 1,000"):
        StudyPlan.from_dict(fields)


def test_steps_that_are_not_those_of_the_stream_are_refused():
    plan = new_plan("-t", "mine.json", "-a", "TD3").plan
    fields = plan.to_dict()
    fields["algorithms"][0]["steps"] = 100
    with pytest.raises(SpecError, match=r"algorithms.0.steps=100: .* steps of their streams"):
        StudyPlan.from_dict(fields)
    with pytest.raises(SpecError, match="stream: its first phase and its steps must be the cell's"):
        Cell.from_dict(plan.cells[0].cell.to_dict() | {"steps": 127})
    assert "stream" not in new_plan("-t", "Default", "-a", "TD3").plan.cells[0].cell.to_dict()
