"""Plans: how those of the catalogue were made, what they take, how they are cut, by command."""

import json
import sys
from pathlib import Path

import pytest

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.spec import StudyAlgorithm, StudyFile, StudyPlan, catalogue
from sme_registry.studies.budget import Estimator, in_implementation, scaled, selected
from sme_registry.studies.cell import run_cell
from sme_registry.studies.runner import run_study
from tests import commands
from tests.studies.cells import raising, small_file

ABLATIONS = catalogue.find(StudyFile, "paper-ablations")
THREE = ("-a", "PPO", "-a", "TD3", "-a", "SAC")

# The plans of the catalogue are what these commands write, with a description.
MADE_BY = {
    "smoke": (
        *("--suite", "smoke", *THREE, "-a", "reference:linear", "--seeds", "2"),
        *("-n", "250", "-n", "PPO=2048", "--evaluations", "10", "--protocol", "quick-v1"),
    ),
    "paper-ablations": (
        *("--suite", "paper-ablations", *THREE, "--seeds", "10"),
        *("-n", "100000", "--evaluations", "400"),
    ),
    "plane-maps": (
        *("-t", "Plane1", "-t", "Plane10", "-t", "Plane50", *THREE, "--seeds", "3"),
        *("-n", "20000", "-n", "PPO=100000", "--evaluations", "100"),
    ),
    "continual": (
        *("-t", "Switch5", "-t", "Related5", "-t", "Cycle2", *THREE),
        *("--seeds", "3", "--instances", "3", "--evaluations", "60"),
        *("--set", "PPO.n_steps=2000", "--set", "PPO.batch_size=50"),  # whole rollouts in a phase
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")


def good(*arguments):
    return commands.good("study", *arguments).stdout


def refused(*arguments):
    message = commands.refused("study", *arguments)
    assert len(message.splitlines()) == 1
    return message


class TestCatalogue:
    @pytest.mark.parametrize("name", MADE_BY)
    def test_a_plan_is_what_its_command_writes(self, name):
        file = catalogue.find(StudyFile, name)
        path = f"{file.versioned_name}.json"
        good("new", path, "--name", name, "--description", file.description, *MADE_BY[name])
        assert file.description
        assert Path(path).read_text() == (catalogue.spec_folder() / "studies" / path).read_text()


class TestScaled:
    def test_budgets_replace_the_plans_and_leave_references_alone(self):
        smoke = catalogue.find(StudyFile, "smoke")
        cut = scaled(smoke, steps=100, steps_of={"TD3": 50}, seeds=1, evaluations=3)
        steps = {planned.algorithm: planned.cell.steps for planned in cut.plan.cells}
        assert steps == {"PPO": 100, "TD3": 50, "SAC": 100, "linear": 0}
        assert {planned.cell.evaluations for planned in cut.plan.cells} == {3}
        assert len(cut.plan.cells) == 3 * 4
        assert (cut.name, cut.digest) == ("smoke-scaled", cut.plan.digest)
        assert scaled(cut, seeds=2).name == "smoke-scaled"

    def test_more_seeds_keep_every_cell_of_fewer_and_as_many_the_plan(self):
        few, many = (
            {planned.cell.digest for planned in scaled(ABLATIONS, seeds=seeds).plan.cells}
            for seeds in (2, 4)
        )
        assert few < many
        assert scaled(ABLATIONS, steps=100_000, seeds=10) is ABLATIONS

    def test_a_selection_has_any_pattern_of_a_kind_and_every_kind(self):
        found = selected(ABLATIONS.plan.cells, ["class=k-*", "class=default", "algorithm=[PT]*"])
        assert {cell.class_name for cell in found} == {"k-5", "k-10", "k-25", "k-100", "default"}
        assert {cell.algorithm for cell in found} == {"PPO", "TD3"}
        assert len(found) == 5 * 2 * 10
        few = selected(ABLATIONS.plan.cells, ["class=k-*", "run=0", "run=[34]"])
        assert {cell.run for cell in few} == {0, 3, 4}
        assert selected(ABLATIONS.plan.cells) == ABLATIONS.plan.cells


class TestEstimate:
    def test_without_results_it_is_that_of_a_fast_core(self):
        by_algorithm = {cell.algorithm: cell.cell for cell in ABLATIONS.plan.cells[:3]}
        ppo, td3 = (Estimator().seconds(by_algorithm[name]) for name in ("PPO", "TD3"))
        assert (ppo, td3) == pytest.approx((62.0, 1202.0))

    def test_what_has_finished_replaces_the_table_for_its_algorithm_alone(self):
        few, many = (small_file(1, evaluations=n).plan.cells[0].cell for n in (10, 20))
        result = run_cell(few)
        slow = result.model_copy(
            update={"timing": result.timing.model_copy(update={"total": 60.0})}
        )
        estimator = Estimator([slow])
        assert estimator.seconds(many) == pytest.approx(60.0)
        assert estimator.seconds(ABLATIONS.plan.cells[0].cell) == Estimator().seconds(
            ABLATIONS.plan.cells[0].cell
        )


class TestCommands:
    def test_a_plan_says_what_it_takes_before_anything_runs(self):
        made = json.loads(good("plan", "paper-ablations", "--cores", "64", "-j", "2", "--json"))
        assert (made["cells"], made["done"]) == (780, 0)
        assert (len(made["classes"]), made["algorithms"]) == (26, ["PPO", "TD3", "SAC"])
        seconds = {entry["cores"]: entry["seconds"] for entry in made["seconds"]}
        assert list(seconds) == [1, 2, 64]
        assert (seconds[2], seconds[64]) == (seconds[1] / 2, seconds[1] / 64)
        text = good("plan", "paper-ablations", "--cores", "64", "-j", "2")
        for words in ("780 cells", "cluster, 64 cores", "this machine, 2 at once", "260", "k-100"):
            assert words in text
        assert "From a table of costs, not from results: PPO, SAC, TD3" in text

    def test_scales_and_selections_mean_the_same_to_plan_run_and_status(self, tmp_path):
        small_file(seeds=4, algorithms=["optimal", "constant"]).write(tmp_path / "p.json")
        cut = ("--seeds", "3", "--only", "algorithm=opt*")
        assert json.loads(good("plan", "p.json", *cut, "--json"))["cells"] == 3
        options = ("-f", "s", "--executor", "in-process", "--json")
        ran = json.loads(good("run", "p.json", *cut, *options))
        assert (ran["study"], ran["cells"], ran["done"]) == ("small-scaled-v1", 3, 3)
        only = ("--only", "algorithm=opt*")
        found = json.loads(good("status", "s", *only, "--json"))
        assert (found["cells"], found["done"], found["waiting"]) == (3, 3, 0)
        assert found["core_seconds_left"] == 0
        assert json.loads(good("status", "s", "--json"))["waiting"] == 3
        found = json.loads(good("status", "s", "--seeds", "4", *only, "--json"))
        assert (found["cells"], found["done"], found["waiting"]) == (4, 3, 1)
        planned = json.loads(good("plan", "p.json", *only, "--folder", "s", "--json"))
        assert (planned["cells"], planned["done"]) == (4, 3)
        assert planned["estimated_from_results"] == ["reference:optimal"]

    def test_status_shows_what_is_done_what_failed_and_what_is_left(self, tmp_path):
        path = small_file(seeds=3).write(tmp_path / "p.json")
        run_study(path, tmp_path / "s", executor="in-process", run=raising, progress=False)
        text = good("status", "s")
        for words in ("2 !1 / 3", "3 cells: 2 done, 1 failed", "ValueError: this one is broken"):
            assert words in text
        text = good("status", "s", "--seeds", "5")
        assert "on one core" in text

    def test_what_is_no_plan_is_refused(self, tmp_path):
        for given, error in {
            "Default": "is the name of",
            "paper-ablation": "Did you mean",
            3: "plan_file=3: must be a StudyFile",
        }.items():
            with pytest.raises((OptionError, UnknownNameError), match=error):
                run_study(given, tmp_path / "s")
        assert not (tmp_path / "s").exists()

    def test_a_new_plan_has_what_was_asked_for(self):
        options = ("--action-range", "unit", "--action-range", "symmetric", "--seeds", "4")
        algorithms = ("-a", "PPO", "-a", "TQC=sb3_contrib:TQC", "-a", "reference:random")
        good("new", "mine.json", "-t", "Default", "--suite", "smoke", *algorithms, *options)
        plan = StudyFile.read("mine.json").plan
        assert [member.name for member in plan.classes] == [
            "default", "complexity10", "plane10", "Default",
        ]  # fmt: skip
        assert [algorithm.name for algorithm in plan.algorithms] == [
            f"{name} ({where})"
            for name in ("PPO", "TQC", "random")
            for where in ("unit", "symmetric")
        ]
        assert plan.algorithms[2] == StudyAlgorithm(
            name="TQC (unit)", uses="sb3_contrib:TQC", action_range="unit"
        )
        assert plan.algorithms[5].steps == 0
        assert plan.seeds == 4
        assert "--force" in refused("new", "mine.json", "-t", "Default", "-a", "PPO")

    @pytest.mark.parametrize(
        ("command", "words"),
        [
            ("plan smoek", "Did you mean 'smoke"),
            ("plan smoke --steps many", "--steps 'many': must be N or ALGORITHM=N"),
            ("plan smoke --steps PPo=1", "Did you mean 'PPO'"),
            ("plan smoke --seeds 0", "seeds=0: must be in [1"),
            ("plan smoke --only class=defalt", "Did you mean 'default'"),
            ("plan smoke --agents torch", "agents='torch': must be 'sb3' or 'jax'"),
            ("plan smoke --folder nowhere", "holds no study"),
            ("run smoke -f s --ray local --executor processes", "contradicts executor='processes'"),
            (
                "run smoke -f s --executor in-process --jobs 2",
                "jobs=2: must be 1 with executor='in-",
            ),
            ("run smoke -f s --jobs 0", "--jobs"),
            ("run smoke", "--folder"),
            ("run smoke -f s --agents jax --device abacus", "'abacus'"),
            ("status nowhere", "holds no study"),
            ("new x -t Default -a PPO", "must end in .json"),
            ("new x.json -t Default", "--algorithm"),
            ("new x.json -t Default -a PPO -a PPO", "appears twice"),
            ("new x.json -t Default -a PPO -a far=PPO", "far: is PPO under another name"),
            ("new x.json -t Default -a a,b=PPO", "name='a,b': must be letters, digits, spaces and"),
            ("new x.json -t Default -a =PPO", "name='': must be letters, digits"),
            ("new x.json -t Default -a PPO=", "uses='': must have at least 1 character"),
            ("new x.json -t Default -a PPO --set PPO.n_stepz=64", "Did you mean 'n_steps'"),
            ("new x.json -t Default -a PPO --set n=64", "ALGORITHM.NAME"),
            ("new x.json -t Default -a PPO --sweep k", "NAME=VALUE"),
            ("new x.json --suite smoke -a PPO --sweep k=1", "one --task"),
            ("new x.json --suite smoke -a PPO --instances 3", "instances=3: is for --task"),
            ("new x.json -t Switch5 -a reference:linear", "and this is a stream"),
            ("new x.json -t Default -a nomod:foo", "No module named 'nomod'"),
            ("new x.json -t Default -a reference:liner", "Did you mean 'linear'"),
            ("new x.json -t Default -a jax:A2C", "one of jax:PPO, jax:TD3"),
            ("new x.json -t Team2 -a jax:PPO", "and this is the task of a team"),
        ],
    )
    def test_bad_input_is_one_line_and_writes_nothing(self, command, words, tmp_path):
        assert words in refused(*command.split())
        assert list(tmp_path.iterdir()) == []


class TestAgents:
    """The same plan with agents in JAX is another plan, whose results are other results."""

    def test_only_what_learns_online_changes_and_names_stay(self):
        bc = {"name": "BC", "uses": "offline:bc", "hyperparameters": {"nu": 0.5}}
        file = small_file(algorithms=["constant", bc, {"name": "slow", "uses": "ppo"}])
        changed = in_implementation(file, "jax")
        assert [(one.name, one.uses) for one in changed.plan.algorithms] == [
            ("constant", "reference:constant"),
            ("BC", "offline:bc"),
            ("slow", "jax:PPO"),
        ]
        assert changed.versioned_name == "small-jax-v1"
        assert changed.digest == changed.plan.digest != file.digest
        same = [
            ours.cell.digest == theirs.cell.digest
            for ours, theirs in zip(changed.plan.cells, file.plan.cells, strict=True)
        ]
        assert same == [True, True, False] * 2
        assert in_implementation(changed, "jax") == changed
        assert in_implementation(file, "sb3") == file
        assert in_implementation(ABLATIONS, "sb3") == ABLATIONS
        back = in_implementation(in_implementation(ABLATIONS, "jax"), "sb3")
        assert back.plan == ABLATIONS.plan

    @pytest.mark.parametrize("uses", ["A2C", "independent:PPO"])
    def test_an_algorithm_that_jax_does_not_have_is_refused_by_name(self, uses):
        agents = {"agents": [{"action_dim": 1}, {"action_dim": 1}]}
        team = {"state_dim": 2, "action_dim": 2, "team": agents}
        classes = [{"name": "t", "setting": team, "seeds": [1]}]
        fields = {"classes": classes} if "independent" in uses else {}
        file = small_file(algorithms=[{"name": "other", "uses": uses}], **fields)
        with pytest.raises(UnknownNameError, match=f"'other': uses='jax:{uses}'.*jax:PPO"):
            in_implementation(file, "jax")

    def test_both_implementations_are_two_algorithms_of_one_plan(self):
        good("new", "both.json", "-t", "Default", "-a", "PPO", "-a", "jax:PPO", "-a", "TD3")
        algorithms = StudyFile.read("both.json").plan.algorithms
        assert [(one.name, one.uses) for one in algorithms] == [
            ("PPO", "PPO"),
            ("jax-PPO", "jax:PPO"),
            ("TD3", "TD3"),
        ]
        good("new", "jax.json", "-t", "Default", "-a", "PPO", "--agents", "jax", "-n", "PPO=7")
        (algorithm,) = StudyFile.read("jax.json").plan.algorithms
        assert (algorithm.name, algorithm.uses, algorithm.steps) == ("PPO", "jax:PPO", 7)


def test_a_plan_of_what_is_not_installed_is_planned_with_a_note(tmp_path):
    theirs = [{"name": name, "uses": "theirs:make"} for name in ("one", "other")]
    small_file(algorithms=["constant", *theirs]).write(tmp_path / "p.json")
    result = commands.good("study", "plan", "p.json", "--json")
    assert json.loads(result.stdout)["algorithms"] == ["constant", "one", "other"]
    (line,) = result.stderr.splitlines()
    assert line.startswith("cannot run here: algorithm='theirs:make': cannot be imported")
    assert commands.good("study", "plan", "p.json", "--only", "algorithm=constant").stderr == ""
    assert "theirs:make" in refused("run", "p.json", "-f", "s")
    assert "theirs:make" in refused("new", "n.json", "--from", "p.json")


def test_a_plan_is_written_where_the_learners_are_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    result = commands.good("study", "new", "n.json", "-t", "Default", "-a", "PPO", "-a", "TD3")
    note = "cannot run here: training: Stable-Baselines3 is not installed"
    assert result.stderr.count(note) == 1
    assert [one.uses for one in StudyFile.read("n.json").plan.algorithms] == ["PPO", "TD3"]


class TestEdited:
    """A plan that was changed by hand becomes a file again by the command that the error names."""

    def written(self, form):
        """Write edited.json, with hyperparameters; the plan that it is meant to be."""
        file = small_file()
        plain = file.to_dict()
        plain["plan"]["algorithms"][0].update(uses="PPO", hyperparameters={"n_steps": 64})
        if form == "no digest":
            del plain["digest"]
        Path("edited.json").write_text(json.dumps(plain["plan"] if form == "bare" else plain))
        return StudyPlan.from_dict(plain["plan"])

    @pytest.mark.parametrize("form", ["old digest", "no digest", "bare"])
    def test_the_error_names_the_command_that_makes_it_a_file(self, form):
        plan = self.written(form)
        for command in (("plan",), ("run", "-f", "study")):
            text = refused(*command, "edited.json")
            assert "`sme study new NEW.json --from edited.json`" in text
            assert ("digest=" in text) == (form == "old digest")
        good("new", "new.json", "--from", "edited.json")
        file = StudyFile.read("new.json")
        assert file.plan == plan
        assert file.plan.algorithms[0].hyperparameters == {"n_steps": 64}
        expected = ("new", "") if form == "bare" else ("small", "For tests.")
        assert (file.name, file.description) == expected
        assert json.loads(good("plan", "new.json", "--json"))["digest"] == plan.digest

    def test_it_may_take_a_name_and_the_place_of_what_was_edited(self):
        plan = self.written("old digest")
        itself = ("new", "edited.json", "--from", "edited.json")
        assert "--force" in refused(*itself)
        good(*itself, "--force", "--name", "other", "--description", "")
        file = StudyFile.read("edited.json")
        assert (file.name, file.description, file.plan) == ("other", "", plan)

    def test_a_plan_of_the_catalogue_is_copied_to_be_edited(self):
        good("new", "mine.json", "--from", "paper-ablations")
        assert StudyFile.read("mine.json") == ABLATIONS

    @pytest.mark.parametrize(
        ("option", "words"),
        [
            ("--seeds 10", "--seeds: the plan of --from already sets it"),
            ("--action-range unit", "--action-range: the plan of --from"),
            ("--name a\tb", "name='a\\tb'"),
        ],
    )
    def test_what_the_plan_says_already_is_no_option(self, option, words):
        self.written("bare")
        assert words in refused("new", "new.json", "--from", "edited.json", *option.split(" "))
        assert not Path("new.json").exists()

    def test_what_is_no_plan_is_refused(self):
        Path("edited.json").write_text("[]")
        assert "must be a valid dictionary" in refused("new", "new.json", "--from", "edited.json")
        assert not Path("new.json").exists()
