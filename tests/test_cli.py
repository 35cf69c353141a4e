"""The command line, as it is typed: what it prints, what it refuses, what it leaves behind."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import sme_registry
from sme_registry import EvaluationReport, SMESpec, StreamSpec, load, save
from sme_registry.evaluation import StreamReport
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    StreamFile,
    StudyFile,
    Suite,
    SuiteFile,
    catalogue,
)
from sme_registry.task.certificate import certify
from tests.commands import good, refused, sme

SME = [sys.executable, "-c", "from sme_registry.cli import main; main()"]
KINDS = (EnvFile, StreamFile, SuiteFile, ProtocolFile, StudyFile)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Every command runs in an empty folder, on a terminal of known width."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("PYTHONPATH", str(Path(sme_registry.__file__).parents[1]))


def test_show_does_not_call_another_task_by_a_name_of_the_catalogue():
    good("new", "mine.json", "--k", "2", "--name", "Default")
    title = good("show", "mine.json").stdout.splitlines()[0]
    assert load("mine.json").content_name in title
    assert "Default-v1" not in title


def test_suite_writes_a_file_of_tasks_files_sweeps_and_another_suite(tmp_path):
    good("new", "k2.json", "--k", "2", "--seed", "7")
    printed = good("new", "mine.json", "-t", "Default", "-t", "k2.json", "--instances", "3").stdout
    file = SuiteFile.read(tmp_path / "mine.json")
    assert file.digest in printed
    assert file.suite.instances[3:] == tuple(SMESpec(k=2, seed=seed) for seed in (7, 8, 9))
    good("new", "wider.json", "--suite", "mine.json", "-t", "Plane10")
    wider = SuiteFile.read(tmp_path / "wider.json").suite
    assert [member.name for member in wider.classes] == ["Default", "k2", "Plane10"]
    good("new", "axis.json", "-t", "Default", "--sweep", "k=1,5")
    axis = SuiteFile.read(tmp_path / "axis.json").suite
    assert [spec.k for spec in axis.instances] == [1, 5]
    good("study", "new", "plan.json", "--suite", "wider.json", "-a", "reference:linear")
    assert StudyFile.read(tmp_path / "plan.json").plan.classes == wider.classes
    before = (tmp_path / "mine.json").read_bytes()
    assert "--force" in refused("new", "mine.json", "-t", "Default")
    assert "twice" in refused("new", "other.json", "-t", "Default", "-t", "Default")
    assert "--task" in refused("new", "other.json", "--sweep", "k=1,5")
    assert "--task" in refused("new", "other.json", "--instances", "2")
    assert "--k: is for a task" in refused("new", "other.json", "-t", "Default", "--k", "2")
    assert "and --sweep" in refused("new", "other.json", "--sweep", "k=1,5", "--k", "2")
    assert (tmp_path / "mine.json").read_bytes() == before
    assert not (tmp_path / "other.json").exists()
    assert "is the file of a suite, not of a task" in refused("train", "mine.json")
    assert "--suite FILE" in refused("train", SMESpec(k=2, seed=8).digest)


def test_train_refuses_what_a_stream_cannot_have():
    stream = refused("train", "Switch5", "--set", "complexity=3")
    assert "--set complexity: Switch5 is a stream." in stream
    for field in ("cycles", "phases.0.steps"):
        own = refused("train", "Switch5", "-a", "PPO", "--set", f"{field}=3")
        assert "is a stream. It is a field of streams" in own
    assert "PPO has no such" in refused("train", "Default", "-a", "PPO", "--set", "cycles=3")
    assert "make another stream in Python" in stream
    assert "steps=100: must be 100,000" in refused("train", "Switch5", "-n", "100")
    assert "num_envs=2: must be 1 on a stream" in refused("train", "Switch5", "--num-envs", "2")


def test_train_takes_a_task_or_a_suite_and_refuses_options_of_the_other():
    assert "--suite" in refused("train")
    assert "TASK" in refused("train", "Default", "--suite", "smoke")
    assert "--num-envs" in refused("train", "--suite", "smoke", "--num-envs", "2")
    assert "--seeds" in refused("train", "Default", "--seeds", "2")
    assert "sme new" in refused("train", "--suite", "smoke", "--set", "k=2")
    assert "seeds" in refused("train", "--suite", "smoke", "--seeds", "0")
    assert "'nothing'" in refused("train", "--suite", "nothing")
    assert not list(Path().iterdir())


def test_the_version_is_the_packages():
    assert good("--version").stdout.strip() == f"sme {sme_registry.__version__}"


def test_the_command_alone_shows_the_help_and_nothing_else():
    result = sme()
    assert result.exit_code == 2
    assert "Commands" in result.output
    assert "error" not in result.output


@pytest.mark.parametrize(
    "arguments",
    [("frob",), ("train",), ("list", "--kind", "x"), ("new",), ("train", "Default", "-n", "many")],
)
def test_a_usage_error_is_one_line_that_points_to_the_help(arguments):
    message = refused(*arguments)
    assert len(message.splitlines()) == 1
    assert "--help`." in message


@pytest.mark.parametrize(
    ("command", "instead"),
    [
        ("suite new mine.json -t Default", "sme new mine.json"),
        ("validate mine.json", "sme check"),
        ("certify Default", "sme check"),
        ("dataset make Default", "sme data make"),
        ("offline train x -a bc", "sme train --data"),
        ("explore runs/demo", "sme diagnose --explore"),
    ],
)
def test_a_command_of_before_says_what_replaces_it(command, instead):
    message = refused(*command.split())
    assert instead in message
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("evaluate x.pt Default", "is a PyTorch file, which lacks the network's code"),
        ("train x.onnx", "To evaluate it: sme evaluate x.onnx TASK"),
        ("train --suite Default", "is the name of a task, not of a suite. To train on it alone"),
        ("train smoke", "is the name of a suite, not of a task. To train on all of its tasks: sme"),
        ("train Default --lr 0.1", "--set lr=VALUE"),
        ("new x.json --set shaping.scale=3", "of a block takes JSON, such as --shaping"),
        ("train Default --set lr=0.1", "Did you mean 'learning_rate'"),
        ("train Default --step 5", "Did you mean '--steps'"),
        ("train Default -n 1e5 --seed -1", "seed=-1"),
        ("study new a.json -t Default --sweep k=1:100 -a PPO", "k=1:100: a range is not expanded"),
        ("show :x:.json", ":x:.json: cannot be read"),
        ("show newer.json", "a newer version wrote it. Upgrade"),
        ("train report.json", "is a report, or the record of a run, on the task 'sha256:0"),
    ],
)
def test_a_beginners_mistake_is_named_with_its_remedy(command, message, tmp_path):
    good("new", "newer.json")
    text = (tmp_path / "newer.json").read_text().replace('_version": 1', '_version": 9')
    (tmp_path / "newer.json").write_text(text)
    report = {"spec": {}, "spec_digest": "sha256:0", "regions": []}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert message in refused(*command.split())


class TestList:
    def test_json_holds_the_whole_catalogue_and_nothing_else(self):
        entries = json.loads(good("list", "--json").stdout)
        expected = [name for kind in KINDS for name in catalogue.names(kind)]
        assert [entry["name"] for entry in entries] == expected
        for entry in entries:
            if entry["kind"] == "env":
                assert SMESpec.from_dict(entry["spec"]).digest == entry["digest"]

    def test_tables_name_every_entry_and_count_the_agents(self):
        text = good("list").stdout
        for kind in KINDS:
            assert all(name in text for name in catalogue.names(kind))
        for name, agents in (("Team8", "8"), ("Default", "1")):
            (row,) = [line for line in text.splitlines() if f"SME/{name}-v1" in line]
            assert row.split()[1] == agents

    def test_filters_by_kind_and_tag(self):
        suites = json.loads(good("list", "--kind", "suite", "--json").stdout)
        assert {entry["kind"] for entry in suites} == {"suite"}
        tagged = json.loads(good("list", "--tag", "paper", "--json").stdout)
        assert 0 < len(tagged) < len(json.loads(good("list", "--json").stdout))
        assert all("paper" in entry["tags"] for entry in tagged)
        assert "paper" in refused("list", "--tag", "papre")
        assert json.loads(good("list", "--tag", "papre", "--json").stdout) == []


class TestShow:
    def test_derived_facts_are_those_of_the_environment(self):
        facts = json.loads(good("show", "Interval25", "--json").stdout)["derived"]
        task = sme_registry.materialize(load("Interval25"))
        numbers = task.W.size + task.b.size + sum(W.size + b.size for W, b in task.policies[0])
        assert facts["parameters"] == numbers
        assert facts["parameter_memory_bytes"] == 8 * numbers
        assert (facts["largest_return"], facts["payouts_in_a_full_episode"]) == (100, 4)

    @pytest.mark.parametrize(
        ("name", "fact", "value"),
        [
            ("CompensatedSafety20", "largest_return_without_cost", 100),
            ("Foresight30", "largest_return", "100 − P₀(s₀), with the potential P₀ in [0, 30]"),
            ("NoisyReward30", "largest_return", "100 on average"),
            ("NoisyState30", "largest_return", 100),
        ],
    )
    def test_the_largest_return_is_that_of_the_optimum(self, name, fact, value):
        facts = json.loads(good("show", name, "--json").stdout)["derived"]
        returns = {key: facts[key] for key in facts if key.startswith("largest_return")}
        assert returns == {fact: value}
        assert re.search(rf"^{fact} +{re.escape(str(value))}$", good("show", name).stdout, re.M)

    def test_limits_and_what_the_agent_sees_are_fields_and_facts(self):
        observation = {"distractors": 32, "dynamics": "driven", "mixing": "nonlinear"}
        options = ("--safety", '{"tightness": 0.2}', "--observation", json.dumps(observation))
        good("new", "a.json", *options)
        text = good("show", "a.json").stdout
        for line in (
            r"safety\.tightness +0\.2", r"observation\.distractors +32",
            r"observation\.dynamics +driven", r"observation\.mixing +nonlinear",
            r"observation\.mixing_depth +1", r"limits +in \[0\.6, 1\], one for each action channel",
        ):  # fmt: skip
            assert re.search(f"^{line}$", text, re.M)
        seen = "nonlinear mixing of state and 32 distractors"
        derived = json.loads(good("show", "a.json", "--json").stdout)["derived"]
        assert derived["observation"] == f"[42] float32 in [0, 1]: {seen}, t/T, r_cum/k"
        good("new", "b.json", "--observation", '{"mixing": "orthogonal"}')
        derived = json.loads(good("show", "b.json", "--json").stdout)["derived"]
        assert "[10] float32 in [0, 1]: orthogonal mixing of state, t/T" in derived["observation"]
        text = good("show", "Default").stdout
        assert "limits" not in text
        assert re.search(r"^safety +None$", text, re.M)
        good("new", "c.json", "--safety", '{"tightness": 0.2}')
        good("new", "s.json", "-t", "c.json", "--sweep", "safety.tightness=0.1,0.4")
        text = good("show", "s.json").stdout
        assert re.search(r"safety-tightness-0_4 +safety\.tightness=0\.4 ", text)

    def test_who_owns_and_sees_and_is_paid_for_what_is_a_table(self):
        text = good("show", "TeamBlind4").stdout
        rows = [line for line in text.splitlines() if line.startswith("agent_")]
        cells = [re.split("  +", row) for row in rows]
        assert cells == [
            ["agent_0", "0–1", "0–3", "[6]", "own channels"],
            ["agent_1", "2–3", "2–5", "[6]", "own channels"],
            ["agent_2", "4–5", "4–7", "[6]", "own channels"],
            ["agent_3", "6–7", "0–1, 6–7", "[6]", "own channels"],
        ]
        assert "4 agents, individual reward" in text
        assert "all channels" in good("show", "TeamShared2").stdout
        assert "Agents" not in good("show", "Default").stdout
        derived = json.loads(good("show", "TeamBlind4", "--json").stdout)["derived"]
        assert derived["agents"][3]["observed_channels"] == [0, 1, 6, 7]

    def test_people_see_the_fields_of_every_kind(self):
        text = good("show", "Survival25").stdout
        for words in ("state_dim", load("Survival25").digest, "largest_return", "0.25"):
            assert words in text
        assert "team=8 agents, individual reward" in good("show", "teams").stdout
        assert "complexity=10" in good("show", "core").stdout
        assert "epsilons" in good("show", "paper-v1").stdout

    def test_a_stream_of_a_suite_is_shown_and_certified_by_its_digest(self):
        """It is in no file of its own."""
        stream = catalogue.find(SuiteFile, "continual").suite.streams[-1].instances[-1]
        shown = json.loads(good("show", stream.digest[:19], "--json").stdout)
        assert shown == {"stream": stream.to_dict(), "digest": stream.digest}
        assert stream.digest in good("show", stream.digest[:19]).stdout
        (checked,) = json.loads(good("check", stream.digest[:19], "--json").stdout)
        assert len(checked["certificates"]) == len(stream.phases)

    def test_a_suite_lists_its_instances_by_names_to_train_by(self, tmp_path):
        file = catalogue.find(SuiteFile, "smoke")
        shown = json.loads(good("show", "smoke", "--json").stdout)
        assert json.loads(good("show", shown["digest"], "--json").stdout) == shown
        assert shown.pop("derived")["instances"] == [
            {"class": member.name, "seed": spec.seed, "digest": spec.digest}
            for member in file.suite.classes
            for spec in member.instances
        ]
        assert shown == file.to_dict()
        text = good("show", "smoke").stdout
        short = re.findall(r"\d+  (sha256:[0-9a-f]{12})$", text, re.M)
        assert [load(name) for name in short] == list(file.suite.instances)
        assert f"sme train {short[0]}" in text
        last = file.suite.instances[-1]
        assert json.loads(good("show", last.digest, "--json").stdout)["spec"] == last.to_dict()
        lines = good("show", "smoke", "--digests").stdout.splitlines()
        assert lines == [spec.digest for spec in file.suite.instances]
        for other in (("Default",), ("smoke", "--json")):
            assert "--digests: applies to suites" in refused("show", *other, "--digests")

        shown["suite"]["classes"] = [{**shown["suite"]["classes"][0], "seeds": [7777]}]
        suite = Suite.from_dict(shown["suite"])
        (tmp_path / "mine.json").write_text(json.dumps({**shown, "digest": suite.digest}))
        text = good("show", "mine.json").stdout
        assert f"7777  {suite.instances[0].digest[:19]}\n" in text
        assert "sme train" not in text

    def test_the_exported_schema_is_the_models(self):
        schema = json.loads(good("show", "--json-schema", "spec").stdout)
        assert schema["properties"].keys() == SMESpec.model_fields.keys()
        assert schema["additionalProperties"] is False
        for kind in ("env-file", "suite", "suite-file", "protocol", "protocol-file"):
            assert "properties" in json.loads(good("show", "--json-schema", kind).stdout)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("Defalt",), "Did you mean 'Default"),
            (("sha256:000000000000",), "no task"),
            (("nowhere.json",), "cannot be read"),
            ((), "Give a name"),
            (("Default", "--json-schema", "spec"), "one or the other"),
            (("--json-schema", "spec", "--digests"), "one or the other"),
        ],
    )
    def test_bad_input(self, arguments, message):
        assert message in refused("show", *arguments)


class TestNew:
    def test_every_field_given_is_in_the_file_and_the_rest_is_default(self, tmp_path):
        fields = {
            "--state-dim": 5, "--action-dim": 3, "--k": 4, "--r-min": 0.25, "--D": 0.5,
            "--complexity": 2, "--horizon": 40, "--hidden-width": 16,
            "--policy-init": "unit_variance", "--seed": 9,
        }  # fmt: skip
        options = [str(part) for pair in fields.items() for part in pair]
        about = ("--name", "Mine", "--description", "A task.", "--tag", "a")
        good("new", "mine.json", *options, *about)
        file = EnvFile.read(tmp_path / "mine.json")
        given = {name.strip("-").replace("-", "_"): value for name, value in fields.items()}
        assert file.spec == SMESpec(**given)  # type: ignore[arg-type]
        assert (file.name, file.description, file.tags) == ("Mine", "A task.", ("a",))
        assert file.digest in good("check", "mine.json", "--files-only").stdout
        good("new", "plain.json")
        assert load(tmp_path / "plain.json") == SMESpec()

    def test_from_derives_and_its_file_is_loaded_by_its_path(self, tmp_path):
        printed = good("new", "a.json", "--from", "HardDeep", "--k", "5").stdout
        spec = load(tmp_path / "a.json")
        assert spec == load("HardDeep").derive(k=5)
        assert spec.digest in printed
        good("new", "b.json", "--from", "a.json", "--seed", "0x1F")
        assert load(tmp_path / "b.json") == spec.derive(seed="0x1f")

    def test_a_team_is_given_as_json(self, tmp_path):
        agents = [{"action_dim": 1, "observes": [0, 3]}, {"action_dim": 3}]
        good("new", "a.json", "--team", json.dumps({"agents": agents, "reward": "team"}))
        made = load(tmp_path / "a.json").team
        assert made is not None
        assert [agent.observes for agent in made.agents] == [(0, 3), "all"]
        assert ([agent.action_dim for agent in made.agents], made.reward) == ([1, 3], "team")

    @pytest.mark.parametrize(
        ("options", "channels"),
        [
            (("--agents", "4"), [1] * 4),
            (("--agents", "2", "--action-dim", "6"), [3] * 2),
            (("--from", "Team8", "--agents", "3", "--action-dim", "3"), [1] * 3),
        ],
    )
    def test_a_team_of_equals_is_given_by_numbers(self, options, channels, tmp_path):
        good("new", "team.json", *options)
        spec = load(tmp_path / "team.json")
        assert spec.team is not None
        assert [agent.action_dim for agent in spec.team.agents] == channels
        assert {agent.observes for agent in spec.team.agents} == {"all"}
        assert (spec.action_dim, spec.team.reward) == (sum(channels), "individual")

    def test_a_file_that_is_there_is_replaced_only_by_force(self, tmp_path):
        good("new", "a.json", "--seed", "1")
        before = (tmp_path / "a.json").read_bytes()
        assert "--force" in refused("new", "a.json", "--seed", "2")
        assert (tmp_path / "a.json").read_bytes() == before
        good("new", "a.json", "--seed", "2", "--force")
        assert load(tmp_path / "a.json").seed == 2

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (("--complexity", "0"), "complexity=0: must be"),
            (("--state-dim", "1000000", "--action-dim", "1000000"), "GiB"),
            (("--team", "two"), "team='two': must be"),
            (("--safety", '{"tightness": 0.6}'), "safety.tightness=0.6: must be in"),
            (("--team", "two", "--agents", "2"), "one or the other"),
            (("--agents", "3"), "shared equally"),
            (("--agents", "1000000000"), "1,024"),
            (("--agents", "2", "--action-dim", "5"), "cannot be shared equally"),
            (("--from", "Defalt"), "Did you mean"),
            (("--name", "a b"), "name='a b'"),
        ],
    )
    def test_bad_input_leaves_no_file(self, options, message, tmp_path):
        assert message in refused("new", "a.json", *options)
        assert list(tmp_path.iterdir()) == []


class TestValidate:
    def test_each_kind_is_told_and_folders_are_searched(self):
        results = json.loads(
            good("check", catalogue.spec_folder(), "--files-only", "--json").stdout
        )
        assert {result["kind"] for result in results} == {
            "env",
            "stream",
            "suite",
            "protocol",
            "study",
        }
        assert all(result["valid"] for result in results)
        assert len(results) == sum(len(catalogue.paths(kind)) for kind in KINDS)

    def test_all_files_are_checked_and_each_bad_one_says_why(self, tmp_path):
        good("new", "good.json")
        data = json.loads((tmp_path / "good.json").read_text())
        broken = {
            "digest.json": {**data, "digest": "sha256:" + "0" * 64},
            "fingerprint.json": {
                **data, "fingerprint": {**data["fingerprint"], "optimal_action": [[0.5] * 4] * 3}
            },
            "field.json": {**data, "spec": {**data["spec"], "kk": 1}},
            "bare.json": data["spec"],
            "list.json": [],
        }  # fmt: skip
        for name, content in broken.items():
            (tmp_path / name).write_text(json.dumps(content))
        (tmp_path / "nan.json").write_text('{"spec": NaN}')
        (tmp_path / "cut.json").write_text('{"spec": {')
        names = [*broken, "nan.json", "missing.json", "cut.json", "good.json"]

        result = sme("check", *names, "--files-only", "--json")
        assert result.exit_code == 2
        results = {entry["name"]: entry for entry in json.loads(result.stdout)}
        assert list(results) == names
        assert [name for name in names if results[name]["valid"]] == ["good.json"]
        expected = {
            "digest.json": "digest=", "fingerprint.json": "fingerprint.optimal_action",
            "field.json": "Did you mean 'k'", "bare.json": "bare spec", "list.json": "must be",
            "nan.json": "NaN", "missing.json": "cannot be read", "cut.json": "line 1",
        }  # fmt: skip
        for name, words in expected.items():
            assert words in results[name]["error"]
            assert name in results[name]["error"]
        assert "8 of 9 files are invalid" in result.stderr

    def test_a_task_too_large_to_certify_stops_no_other(self, tmp_path):
        good("new", "wide.json", "--state-dim", 50_000, "--action-dim", 2)
        good("new", "good.json", "--seed", 5)
        result = sme("check", "wide.json", "good.json", "--json")
        assert result.exit_code == 2
        wide, sound = json.loads(result.stdout)
        assert "GiB" in wide["error"]
        assert (wide["valid"], sound["valid"]) == (False, True)
        assert sound["certificates"][0]["passed"]

    def test_an_empty_folder_is_refused(self, tmp_path):
        (tmp_path / "empty").mkdir()
        assert "no .json" in refused("check", "empty")


class TestCertify:
    def test_a_sound_task_passes_with_its_numbers(self):
        (made,) = json.loads(good("check", "Default", "--json").stdout)[0]["certificates"]
        assert made == {"task": "Default", **certify(load("Default")).to_dict()}
        text = good("check", "Default").stdout
        assert all(check.name in text for check in certify(load("Default")).checks)

    def test_a_trivial_task_exits_with_one(self):
        good("new", "trivial.json", "--state-dim", "2", "--action-dim", "2", "--complexity", "3")
        result = sme("check", "trivial.json")
        assert result.exit_code == 1
        assert re.search(r"^refused +trivial.json +constant_policy_similarity", result.stdout, re.M)
        assert sme("check", "Default", "trivial.json").exit_code == 1

    def test_a_trivial_agent_among_others_is_found_and_named(self):
        team = '{"agents": [{"action_dim": 4, "observes": [0]}, {"action_dim": 4}]}'
        good("new", "t.json", "--action-dim", "8", "--seed", "1", "--team", team)
        (made,) = json.loads(good("check", "t.json", "--json").stdout)[0]["certificates"]
        checks = {check["name"]: check for check in made["checks"]}
        of_agent = checks.pop("agent_constant_policy_similarity")
        assert of_agent["outcome"] == "warning"
        assert "agent_0" in of_agent["meaning"]
        # Nothing else shows it.
        assert {check["outcome"] for check in checks.values()} == {"passed", "reported"}


QUICK = ("--protocol", "quick-v1")


def save_life():
    """Write life.json, two phases in two cycles."""
    spec = load("Plane1", SMESpec).derive(hidden_width=8, horizon=20)
    phases = [{"spec": each, "steps": 60} for each in (spec, spec.derive(seed=1))]
    save(StreamSpec(phases=phases, cycles=2), "life.json")


class TestEvaluate:
    def test_a_team_has_the_scores_of_its_agents_and_on_request_shows_them(self):
        shown = ("evaluate", "constant", "TeamBlind4", *QUICK)
        team = json.loads(good(*shown, "--json").stdout)
        assert list(team["agents"]) == [f"agent_{i}" for i in range(4)]
        assert "agent_3" in good(*shown, "--all").stdout
        lines = [line for line in good(*shown).stdout.splitlines() if line.startswith("  ")]
        names = [line.split("  ")[1] for line in lines if not line.startswith("    ")]
        assert names == 2 * ["constant", "linear", "random", "optimal"]

    def test_a_function_is_the_policy_that_a_team_shares(self, tmp_path):
        (tmp_path / "shared_for_the_test.py").write_text(
            "import numpy as np\n"
            "def act(observations):\n"
            "    assert observations.shape[1] == 8 + 2 + 4\n"
            "    return np.full((len(observations), 2), 0.5)\n"
        )
        arguments = ("evaluate", "shared_for_the_test:act", "Team4", *QUICK, "--json")
        report = json.loads(good(*arguments).stdout)
        assert report["regions"][0]["normalised_regret"] == pytest.approx(1.0)
        assert "for each agent in turn" in refused("evaluate", "math:sqrt", "Team4", *QUICK)

    def test_the_folder_gets_report_and_figures_and_is_not_overwritten(self, tmp_path):
        good("evaluate", "constant", "Plane1", *QUICK, "--out", "ev")
        names = sorted(path.name for path in (tmp_path / "ev").iterdir())
        assert names == [
            "decay_curve.pdf", "decay_curve.png", "evaluation.json", "similarity_map.pdf",
            "similarity_map.png",
        ]  # fmt: skip
        assert EvaluationReport.read(tmp_path / "ev/evaluation.json").policy == "constant"
        assert "--force" in refused("evaluate", "random", "Plane1", *QUICK, "--out", "ev")
        assert "Add --out" in refused("evaluate", "random", "Plane1", *QUICK, "--force")
        assert EvaluationReport.read(tmp_path / "ev/evaluation.json").policy == "constant"
        good("evaluate", "random", "Plane1", *QUICK, "--out", "ev", "--force")
        assert EvaluationReport.read(tmp_path / "ev/evaluation.json").policy == "random"

    @pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
    def test_a_function_of_ones_own_is_evaluated_in_the_range_it_says(self, tmp_path):
        (tmp_path / "mine_for_the_test.py").write_text(
            "import numpy as np\n"
            "def act(observations):\n    return np.zeros((len(observations), 4))\n"
        )
        arguments = ("evaluate", "mine_for_the_test:act", "Default", *QUICK, "--json")
        report = json.loads(good(*arguments, "--action-range", "symmetric").stdout)
        half = report["references"]["constant"][0]["similarity"]
        assert report["regions"][0]["similarity"] == pytest.approx(half, abs=1e-12)
        lower = json.loads(good(*arguments).stdout)["regions"][0]["similarity"]
        assert lower < half - 0.1
        (tmp_path / "tanh_for_the_test.py").write_text(
            "import numpy as np\n"
            "def act(observations):\n    return np.full((len(observations), 4), -0.5)\n"
        )
        note = "100% of the actions in WD are outside [0, 1] and were clipped."
        command = ("evaluate", "tanh_for_the_test:act", "Default", *QUICK)
        assert note in good(*command).stderr
        assert note not in good(*command, "--action-range", "symmetric").stderr

    def test_overrides_evaluate_the_derived_task(self):
        text = good(
            "evaluate", "constant", "Default", *QUICK, "--set", "complexity=3", "--json"
        ).stdout
        assert json.loads(text)["spec_digest"] == load("Default").derive(complexity=3).digest

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("optmal", "Default"), "Did you mean 'optimal'"),
            (("math:sqrt", "Default"), "failed on observations"),
            (("optimal", "Defalt"), "Did you mean"),
            (("optimal", "Default", "--protocol", "papr-v1"), "Did you mean 'paper-v1'"),
            (("optimal", "Default", "--set", "complexity"), "NAME=VALUE"),
            (("optimal", "Default", "--set", "complexty=2"), "Did you mean 'complexity'"),
            (("optimal", "Default", "--set", "k=2", "--set", "k=3"), "twice"),
        ],
    )
    def test_bad_input_writes_nothing(self, arguments, message, tmp_path):
        assert message in refused("evaluate", *arguments, "--out", "ev")
        assert list(tmp_path.iterdir()) == []

    def test_a_policy_for_a_whole_life_is_reported_with_its_dynamic_regret(self, tmp_path):
        save_life()
        result = good("evaluate", "constant", "life.json", *QUICK, "--out", "ev")
        report = StreamReport.read(tmp_path / "ev/stream.json")
        assert report.dynamic_regret == report.reference_regret["constant"]
        assert report.region().agent.normalised_regret[3] == pytest.approx((1.0, 1.0))
        regret = f"{report.dynamic_regret.dynamic_regret:,.1f}"
        assert f"dynamic regret {regret} over 240 steps" in result.stdout
        assert "visit 3: phase 1" in result.stdout
        names = {path.stem for path in (tmp_path / "ev").iterdir()}
        assert names == {"stream", "retention_map", "performance_curve", "dynamic_regret_curve"}
        assert "--force" in refused("evaluate", "random", "life.json", *QUICK, "--out", "ev")

    def test_a_life_has_a_policy_for_each_visit(self):
        save_life()
        life = ("evaluate", "optimal", "constant", "constant", "optimal", "life.json", *QUICK)
        others = ("--initial", "constant", "--fresh", "linear", "--fresh", "constant")
        report = json.loads(good(*life, *others, "--json").stdout)
        agent = report["regions"][0]["agent"]
        assert [row[0] for row in agent["normalised_regret"]] == pytest.approx([0, 1, 1, 0])
        assert agent["initial_normalised_regret"] == pytest.approx([1.0, 1.0])
        assert agent["fresh_normalised_regret"][1] == pytest.approx(1.0)
        assert agent["fresh_normalised_regret"][0] < 0.5
        assert report["dynamic_regret"] is None
        assert report["reference_regret"].keys() > {"constant", "fresh_optimum"}
        assert "\n\nNormalised regret in WD" in good(*life).stdout

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("random", "random", "life.json"), "2 policies: must be one for the whole life, or 4"),
            (("randm", "life.json"), "Did you mean 'random'"),
            (("random", "life.json", "--set", "k=2"), "--set k: life.json is a stream. It is a"),
            (("random", "life.json", "--set", "cycles=2"), "`StreamSpec(**dict(stream) | {'cyc"),
            (("random", "life.json", "--fresh", "random"), "must be 2 policies, one for each"),
            (("random", "Cycel2"), "Did you mean 'Cycle2-v1'"),
            (("random", "Default", "--fresh", "random"), "--fresh: is for streams"),
        ],
    )
    def test_a_bad_life_writes_nothing(self, arguments, message, tmp_path):
        save_life()
        assert message in refused("evaluate", *arguments, *QUICK, "--out", "ev")
        assert [path.name for path in tmp_path.iterdir()] == ["life.json"]


SHORT = ("train", "Plane1", "-n", "120", *QUICK)


class TestTrain:
    @pytest.fixture(autouse=True)
    def _needs_sb3(self):
        pytest.importorskip("stable_baselines3")

    def test_it_trains_on_a_stream_and_shows_what_was_retained_and_what_it_cost(self, tmp_path):
        task = SMESpec(state_dim=2, action_dim=2, horizon=20)
        phases = [{"spec": task, "steps": 40}, {"spec": task.derive(seed=1), "steps": 40}]
        save(StreamSpec(phases=phases), tmp_path / "mine.json")
        ppo = ("-a", "PPO", "--set", "n_steps=40", "--set", "batch_size=40", *QUICK)
        result = good("train", "mine.json", *ppo)
        assert "PPO on mine (S=2, A=2, 2 phases, 2 visits)" in result.stdout
        assert "\n\nNormalised regret in WD on the task of each phase" in result.stdout
        assert "\n\nOnline regret" in result.stdout
        assert "frozen after visit 0" in result.stdout
        assert "phase 1, mean regret" in result.stderr
        folder = tmp_path / "runs" / "mine-PPO-seed0"
        assert (folder / "snapshots" / "visit-01.zip").exists()
        assert "All files are in runs/mine-PPO-seed0/" in result.stdout

    def test_it_trains_reports_and_says_where(self, tmp_path):
        result = good(*SHORT, "--json")
        printed = json.loads(result.stdout)
        assert printed["folder"] == "runs/Plane1-TD3-seed0"
        folder = tmp_path / printed["folder"]
        assert printed["run"]["status"] == "finished"
        assert printed["evaluation"] == json.loads((folder / "evaluation.json").read_text())
        assert "training TD3: 120 of 120 steps" in result.stderr
        assert "Warning" not in result.stderr
        assert "note:" not in result.stderr
        assert "finished run" in refused(*SHORT)
        again = json.loads(
            good("evaluate", folder / "model.zip", "Plane1", *QUICK, "--json").stdout
        )
        assert again["regions"] == printed["evaluation"]["regions"]

    def test_agents_in_jax_have_a_folder_of_their_own(self, tmp_path):
        pytest.importorskip("jax")
        narrow = ("--set", "n_steps=32", "--set", "batch_size=32", "--set", "n_epochs=1")
        command = ("train", "Plane1", "-a", "ppo", "--agents", "jax", "-n", "40", *narrow, *QUICK)
        result = good(*command, "--json")
        printed = json.loads(result.stdout)
        assert printed["folder"] == "runs/Plane1-jax-PPO-seed0"
        assert printed["run"]["algorithm"] == "jax:PPO"
        assert "training PPO: 64 of 64 steps" in result.stderr
        assert (tmp_path / printed["folder"] / "model.zip").exists()
        assert "finished run of jax:PPO" in refused(*command)
        in_jax = ("train", "Plane1", "--agents", "jax")
        assert "num_envs=2" in refused(*in_jax, "--num-envs", "2")
        assert "device='abacus'" in refused(*in_jax, "--device", "abacus")

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (("-a", "TD33"), "Did you mean 'TD3'"),
            (("--agents", "jx"), "agents='jx'"),
            (("--device", "cpu"), "is for agents in JAX"),
            (("--set", "state_dim=x"), "state_dim='x'"),
            (("--set", "complexty=3"), "Did you mean 'complexity'"),
            (("--hyperparameters", "none.json"), "none.json"),
        ],
    )
    def test_bad_input_writes_nothing(self, options, message, tmp_path):
        assert message in refused(*SHORT, *options)
        assert list(tmp_path.iterdir()) == []

    def test_hyperparameters_come_from_options_and_a_file(self, tmp_path):
        (tmp_path / "settings.json").write_text('{"gamma": 0.9}')
        file = ("--hyperparameters", "settings.json")
        options = ("--set", "policy_kwargs.net_arch=[8]", "--set", "k=2", *file)
        printed = json.loads(good(*SHORT, "-n", "30", *options, "--json").stdout)
        assert printed["run"]["hyperparameters"] == {
            "gamma": 0.9,
            "policy_kwargs": {"net_arch": [8]},
        }
        assert printed["run"]["spec"]["k"] == 2
        assert "sets it, too" in refused(*SHORT, *file, "--set", "gamma=0.8")

    def test_a_team_is_trained_with_its_regret_shown(self):
        command = ("train", "SME/Team2-v1", "-n", "300", "--set", "horizon=20", *QUICK)
        result = good(*command, "--out", "run", "--json")
        printed = json.loads(result.stdout)
        assert printed["run"]["algorithm"] == "PPO"
        assert (printed["run"]["agents"], printed["run"]["steps_done"]) == (2, 1024)
        assert "training PPO: 1,024 of 1,024 steps" in result.stderr
        assert "team's mean regret" in result.stderr
        assert "shape" in refused("evaluate", "run/model.zip", "Team4", *QUICK)
        assert "shape" in refused("evaluate", "run/model.zip", "Default", *QUICK)

    def test_an_interrupt_says_how_to_go_on_and_going_on_works(self, tmp_path):
        command = ("train", "Plane1", "--out", "run", "--checkpoint-every", "50", *QUICK)
        process = subprocess.Popen(
            [*SME, *command, "-n", "100000"],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        try:
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline and process.poll() is None:
                record = tmp_path / "run/run.json"
                if record.exists() and json.loads(record.read_text())["episodes"] >= 2:
                    process.send_signal(signal.SIGINT)
                    break
                time.sleep(0.05)
            _, stderr = process.communicate(timeout=60)
        finally:
            process.kill()
        assert process.returncode == 130
        (last,) = [line for line in stderr.splitlines() if line.startswith("error:")]
        assert "--resume" in last
        assert "Traceback" not in stderr
        run = json.loads((tmp_path / "run/run.json").read_text())
        assert run["status"] == "running"
        steps = str(run["steps_done"] + 30)
        log = tmp_path / "run/episodes.csv"
        log.write_text("\n".join(log.read_text().splitlines()[:2]))
        result = good(*command, "-n", steps, "--resume", "--json")
        lost = f"{run['episodes'] - 1} of the {run['episodes']} episodes before the checkpoint"
        assert f"{lost} are missing" in result.stderr
        printed = json.loads(result.stdout)
        assert printed["run"]["sessions"] == 2
        assert printed["run"]["steps_done"] == int(steps)


class TestDemo:
    def test_it_leaves_figures_and_names_them(self, tmp_path):
        pytest.importorskip("stable_baselines3")
        result = good("demo", "--steps", "200", "--out", "demo")
        names = {path.name for path in (tmp_path / "demo").iterdir()}
        figures = {"training_curve.png", "decay_curve.png", "explorer.html"}
        assert names >= {*figures, "model.zip"}
        assert all(f"wrote demo/{name}" in result.stderr for name in figures)
        assert "All files are in demo/" in result.stdout
        assert re.search(r"Mean regret during training.*\n.*\n +\d+ +0\.\d+ +█", result.stdout)
        run = json.loads((tmp_path / "demo/run.json").read_text())
        assert run["hyperparameters"]["policy_kwargs"] == {"net_arch": [64, 64]}
        again = sme("demo", "--out", "demo")
        assert again.exit_code == 2
        assert "demo: contains a finished run" in again.stderr
        (tmp_path / "demo" / "leaderboard").mkdir()  # `make demo` puts its board here
        good("demo", "--steps", "200", "--out", "demo", "--force")
        assert (tmp_path / "demo" / "leaderboard").is_dir()


@pytest.mark.parametrize("arguments", [("show", "TeamBlind4"), ("show", "Défaut")])
def test_output_is_utf8_where_the_system_has_another_encoding(arguments):
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}  # a pipe on Windows
    process = subprocess.run([*SME, *arguments], capture_output=True, check=False, env=environment)
    assert "Traceback" not in process.stderr.decode()
    assert (process.stdout + process.stderr).decode().isascii() is False


@pytest.mark.parametrize("arguments", [["--help"], ["list", "--json"]])
def test_the_help_and_the_catalogue_load_no_other_command(arguments):
    code = (
        "import sys; from sme_registry.cli import app\n"
        "try: app(sys.argv[1:])\n"
        "finally: sys.exit('scipy' in sys.modules or 'sme_registry.task' in sys.modules)"
    )
    command = [sys.executable, "-c", code, *arguments]
    assert subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode == 0


def test_the_installed_command_prints_pure_json_or_one_line_and_its_exit_code():
    listed, unknown = (
        subprocess.run([*SME, *arguments], capture_output=True, check=False, text=True)
        for arguments in (("list", "--json"), ("show", "Defalt"))
    )
    assert (listed.returncode, listed.stderr) == (0, "")
    assert len(json.loads(listed.stdout)) > 30
    assert (unknown.returncode, unknown.stdout) == (2, "")
    assert unknown.stderr.startswith("error: ")
    assert len(unknown.stderr.splitlines()) == 1


@pytest.mark.parametrize("arguments", [("list",), ("show", "core", "--json")])
def test_a_reader_that_leaves_early_is_no_error(arguments):
    read, write = os.pipe()
    process = subprocess.Popen([*SME, *arguments], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    os.close(read)
    _, stderr = process.communicate(timeout=60)
    assert stderr == ""
    assert process.returncode == 0


@pytest.mark.parametrize(
    "command",
    [
        ("data", "make", "Switch5"),
        ("diagnose", "optimal", "--task", "Switch5"),
        ("new", "mine.json", "--from", "Switch5"),
    ],
    ids=lambda command: command[0],
)
def test_a_command_on_one_task_refuses_a_stream(command: tuple[str, ...]) -> None:
    assert "'Switch5': is a stream, and this needs a single task" in refused(*command)
