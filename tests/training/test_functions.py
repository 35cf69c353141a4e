"""`train:module:function`: a function that trains with any framework, at every public door."""

import hashlib
import json
import math
import sys
from pathlib import Path

import pytest

from sme_registry import SMESpec, save
from sme_registry.errors import OptionError, PolicyError, SpecError
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.spec.study import Cell
from sme_registry.studies import load as load_frames
from sme_registry.studies import run_study
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger, study_status
from sme_registry.training import train
from sme_registry.training.record import RunRecord
from tests import commands

SPEC = SMESpec(state_dim=2, action_dim=3, horizon=10, seed=5)
PROTOCOL = {"states_per_region": 20, "epsilons": [1.0]}
MODULE = """
import numpy as np

print("imported")

def centre(env, steps, seed, level=0.0):
    env.reset()
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(env.action_space.sample() * 0 + level)
        assert 0 <= info["regret"] <= 1
        if terminated or truncated:
            env.reset()
    return lambda observations: np.full((len(observations), 3), level)

def early(env, steps, seed):
    env.reset()
    env.step(env.action_space.sample())
    return lambda observations: np.zeros((len(observations), 3))

def greedy(env, steps, seed):
    return centre(env, steps + 1, seed)

def restless(env, steps, seed):
    for length in (5, 10, 10):
        env.reset()
        for _ in range(length):
            env.step(np.zeros(3, np.float32))
    return lambda observations: np.zeros((len(observations), 3))

def nothing(env, steps, seed):
    return None

def ppo(env, steps, seed):
    from stable_baselines3 import PPO
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=seed, device="cpu")
    return model.learn(steps)
"""


@pytest.fixture(autouse=True)
def module(tmp_path, monkeypatch):
    """A module in the working directory, from where the tests run."""
    path = tmp_path / "agents_of_mine.py"
    path.write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    yield path
    sys.modules.pop("agents_of_mine", None)


def uses(function):
    return f"train:agents_of_mine:{function}"


def source(path):
    return f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"


def cell(function="centre", **changes):
    fields = {
        "spec": SPEC, "uses": uses(function), "hyperparameters": {}, "action_range": "symmetric",
        "seed": 3, "steps": 25, "evaluations": 4, "evaluation_episodes": 2, "protocol": PROTOCOL,
    }  # fmt: skip
    return Cell.from_dict({**fields, **changes})


def plan(**changes):
    fields = {
        "classes": [{"name": "small", "setting": {"state_dim": 2, "action_dim": 3}, "seeds": [1]}],
        "algorithms": [
            {"name": "centre", "uses": uses("centre")},
            {"name": "linear", "uses": "reference:linear", "steps": 0},
        ],
        "seeds": 2,
        "steps": 30,
        "evaluations": 3,
        "protocol": PROTOCOL,
    }
    made = StudyPlan.from_dict({**fields, **changes})
    return StudyFile(name="mine", digest=made.digest, plan=made)


def run(file, folder="study", **options):
    return run_study(file, folder, executor="in-process", progress=False, **options)


def test_a_cell_has_its_regret_one_evaluation_and_the_source_of_its_module(module):
    result = run_cell(cell())
    assert result.cell.source == source(module)
    assert result.key == result.cell.digest != cell().digest
    assert result.curve.steps == (25,)
    assert 0.0 < result.online_regret < 1.0
    # The last evaluation is that of any other algorithm: the same policy has the same numbers.
    reference = run_cell(cell(uses="reference:constant", steps=25))
    assert result.curve.similarity[-1] == pytest.approx(reference.curve.similarity[-1])


def test_keys_of_other_cells_have_no_source():
    document = cell(uses="PPO").to_dict()
    assert "source" not in document
    with pytest.raises(SpecError, match=r"source=.*is for uses='train:module:function'"):
        cell(uses="PPO", source=f"sha256:{'0' * 64}")


def test_a_function_may_stop_early_and_not_late():
    assert run_cell(cell("early")).curve.steps == (1,)
    with pytest.raises(PolicyError, match=r"takes more than 25 steps: must stop"):
        run_cell(cell("greedy"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("train:agents_of_yours:centre", "there is no Python module 'agents_of_yours'"),
        ("train:agents_of_mine.inner:centre", "there is no Python module"),
        ("train:agents_of_mine:center", r"has no function 'center'\. Did you mean 'centre'"),
    ],
)
def test_what_is_not_there_is_named(name, message):
    with pytest.raises(OptionError, match=message):
        run_cell(cell(uses=name))
    with pytest.raises(OptionError, match=message):
        train(SPEC, algorithm=name, folder="run", progress=False)


def test_a_wrong_return_and_wrong_hyperparameters_are_refused(module):
    with pytest.raises(PolicyError, match=r"returned None: must be a policy"):
        run_cell(cell("nothing"))
    with pytest.raises(OptionError, match=r"levels: .* has no such hyperparameter"):
        run_cell(cell(hyperparameters={"levels": 1}))
    with pytest.raises(OptionError, match=r"levels: .* has no such hyperparameter"):
        run(plan(algorithms=[
            {"name": "c", "uses": uses("centre"), "hyperparameters": {"levels": 1}}
        ]))  # fmt: skip
    module.write_text("1 / 0")
    with pytest.raises(OptionError, match="cannot be imported: ZeroDivisionError"):
        run_cell(cell())


def test_a_team_and_a_stream_are_refused_before_anything_runs():
    team = {"state_dim": 3, "action_dim": 3, "team": {"agents": [{"action_dim": 3}]}}
    phases = [{"spec": SPEC.to_dict(), "steps": 10}, {"spec": SPEC.to_dict(), "steps": 10}]
    own = [{"name": "centre", "uses": uses("centre")}]
    for classes, streams, kind in (
        ([{"name": "team", "seeds": [1], "setting": team}], [], "the task of a team"),
        ([], [{"name": "s", "stream": {"phases": phases}, "draws": [0]}], "a stream"),
    ):
        with pytest.raises(SpecError, match=f"learns a task of a single agent, and this is {kind}"):
            run(plan(classes=classes, streams=streams, algorithms=own))
    with pytest.raises(SpecError, match="this is the task of a team"):
        train("Team4", algorithm=uses("centre"), folder="run", progress=False)
    assert not Path("study").exists()
    assert not Path("run").exists()


def test_a_study_goes_on_and_another_source_is_another_cell(module):
    run(plan(), only=["algorithm=linear"])
    assert run(plan()).count("done") == 4
    ledger = Ledger("study")
    first = set(ledger.results())
    assert ledger.study_file().plan.algorithms[0].source == source(module)
    assert study_status("study").count("done") == 4

    times = {path: path.stat().st_mtime_ns for path in ledger.folder.glob("cells/*")}
    assert run(plan()).count("done") == 4
    assert times == {path: path.stat().st_mtime_ns for path in ledger.folder.glob("cells/*")}

    module.write_text(MODULE.replace("level=0.0", "level=0.5"))
    assert run(plan()).count("done") == 4
    results = ledger.results()
    assert len(results) == 6  # those of the references are reused
    again = {r.curve.similarity for key, r in results.items() if key not in first}
    before = {r.curve.similarity for key, r in results.items() if key in first}
    assert not again & before
    assert len(load_frames("study").results.groupby("algorithm")) == 2


def test_a_plan_that_states_another_source_is_refused(module):
    run(plan())
    stated = Ledger("study").study_file()
    module.write_text(MODULE + "\n# changed\n")
    with pytest.raises(OptionError, match=r"the source of the module is .* now"):
        run(stated)


def test_processes_find_the_module_in_the_working_directory():
    status = run_study(plan(), "study", jobs=2, progress=False)
    assert (status.count("done"), status.count("failed")) == (4, 0)


def test_documents_are_checked_without_their_code_and_commands_say_whose_code_they_run(capsys):
    plan().write("plan.json")
    assert StudyFile.read("plan.json").plan.algorithms[0].source is None
    assert "agents_of_mine" not in sys.modules
    for words in (["study", "plan", "plan.json"], ["study", "run", "plan.json", "-f", "study"]):
        sys.modules.pop("agents_of_mine", None)
        result = commands.good(*words)
        said = "This plan runs the code of agents_of_mine."
        assert said in result.stderr
        assert "imported" not in result.output.partition(said)[0]


def test_train_writes_the_files_of_a_run(module):
    result = train(SPEC, algorithm=uses("centre"), steps=35, folder="run", protocol=PROTOCOL,
                   progress=False, hyperparameters={"level": 0.5})  # fmt: skip
    assert result.record.source == source(module)
    assert (result.record.steps_done, result.record.episodes) == (35, 3)
    assert [episode.step for episode in result.episodes] == [10, 20, 30]
    assert not result.model_path.exists()
    assert json.loads((result.folder / "run.json").read_text())["status"] == "finished"


def test_an_episode_that_a_reset_breaks_off_is_not_logged():
    result = train(SPEC, algorithm=uses("restless"), steps=25, folder="run", protocol=PROTOCOL,
                   progress=False)  # fmt: skip
    assert [(each.step, each.length) for each in result.episodes] == [(15, 10), (25, 10)]


@pytest.mark.parametrize("value", [math.inf, 2**53 + 1, "\ud800"])
def test_hyperparameters_are_those_that_a_digest_tells_apart(value):
    with pytest.raises(SpecError, match=r"hyperparameters=.*must be plain, finite JSON"):
        cell(hyperparameters={"level": value})


def test_a_model_of_sb3_is_a_policy_and_is_kept():
    pytest.importorskip("stable_baselines3")
    result = train(SPEC, algorithm=uses("ppo"), steps=64, folder="run", protocol=PROTOCOL,
                   progress=False)  # fmt: skip
    assert result.model_path.exists()
    assert run_cell(cell("ppo", steps=64)).online_regret == pytest.approx(
        sum(e.regret * e.length for e in result.episodes) / 60, abs=0.05
    )


def test_a_run_that_failed_starts_again():
    with pytest.raises(PolicyError, match="takes more than"):
        train(SPEC, algorithm=uses("greedy"), steps=20, folder="run", progress=False)
    assert RunRecord.read(Path("run")).status == "running"
    options = {"algorithm": uses("greedy"), "steps": 20, "folder": "run", "progress": False}
    with pytest.raises(OptionError, match=r"Use --resume to continue it.*or --force"):
        train(SPEC, **options)
    with pytest.raises(PolicyError, match="takes more than"):
        train(SPEC, resume=True, **options)


def test_the_command_trains_on_a_task():
    save(SPEC, "task.json")
    options = ["-a", uses("centre"), "-n", "20", "--protocol", "quick-v1"]
    result = commands.good("train", "task.json", *options, "-o", "run")
    assert "All files are in run" in result.output
