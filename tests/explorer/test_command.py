"""`sme diagnose --explore`: what it writes where, what it refuses, and what a page holds."""

import json
import re

import pytest

import sme_registry
from sme_registry import SMESpec, load, materialize
from sme_registry.diagnosis import StreamSubject, load_policy, load_run
from sme_registry.envs.episodes import Episode
from sme_registry.errors import OptionError
from sme_registry.evaluation import evaluate
from sme_registry.evaluation.models import saved_sb3
from sme_registry.evaluation.rollouts import rollouts
from sme_registry.explorer import FILE, facts, run_report, write_explorer
from sme_registry.explorer.page import json_in_html
from sme_registry.task import draw
from sme_registry.training.record import EpisodeLog, RunRecord
from tests.commands import good, refused
from tests.explorer.networks import fitted, offline

SPEC = SMESpec(state_dim=3, action_dim=2)


def data_of(page):
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text())
    return json.loads(match[1])


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sme_registry.save(SPEC, "small.json", name="small")
    offline(SPEC).save("actor.npz")
    return tmp_path


def test_a_task_and_a_policy_become_pages(here):
    good("diagnose", "--explore", "small.json")
    page = here / "small-explorer.html"
    data = data_of(page)
    assert (data["name"], data["title"], data["digest"]) == (None, "small", SPEC.digest)
    assert [each["name"] for each in data["policies"]] == ["linear", "constant ½"]
    refusal = refused("diagnose", "--explore", "small.json")
    assert "already exists. Use --force" in " ".join(refusal.split())
    good("diagnose", "--explore", "small.json", "--set", "k=5", "--force")
    assert data_of(page)["task"]["k"] == 5

    options = ("--task", "small.json", "--out", "a/b.html", "--episodes", "4")
    good("diagnose", "--explore", "actor.npz", *options)
    data = data_of(here / "a" / "b.html")
    policy = data["policies"][0]
    assert (policy["name"], policy["of"]) == ("actor", "observation")
    assert data["episode"]["episodes"] == 4
    assert len(data["episode"]["mean"]) == SPEC.horizon


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["actor.npz"], "for a policy, add the task that it is for, such as --task Default."),
        (["mine:act"], "for a policy, add the task that it is for"),
        (["small.json", "--out", "page.txt"], "must end in .html"),
        (["small.json", "--log", "x.csv"], "--log: is of a policy with --task"),
        (["small.json", "--action-range", "unit"], "--action-range: is of a policy with --task"),
        (["small.json", "--episodes", "0"], "must be an integer in [1, 10,000]"),
        (["."], "contains no run.json"),
        (["Switch5"], "is a stream"),
        (["actor.npz", "-t", "small.json", "--channels", "1"], "must be two channels"),
        (["actor.npz", "-t", "small.json", "--channels", "1,2"], "whose network is unknown"),
        (["small.json", "--channels", "1,2"], "whose network is unknown"),
        (["actor.npz", "-t", "small.json", "--channels", "1,4"], "different channels in [1, 3]"),
        (
            ["small.json", "--set", "complexity=3", "--set", "hidden_width=1500"],
            "is too large for a page",
        ),
        (["small.json", "--set", "state_dim=600"], "must be at most 512"),
    ],
)
def test_what_it_refuses(arguments, message, here):
    before = set(here.iterdir())
    assert message in " ".join(refused("diagnose", "--explore", *arguments).split())
    assert set(here.iterdir()) == before


def test_a_run_has_its_learning_curve_and_its_evaluation(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.PPO("MlpPolicy", sme_registry.make(SPEC, action_range="symmetric"), seed=0)
    (tmp_path / "model.zip").write_bytes(saved_sb3(model))
    protocol = {"states_per_region": 50}
    report = evaluate(model, SPEC, protocol, action_range="symmetric")
    report.write(tmp_path / "evaluation.json")
    log = EpisodeLog(tmp_path / "episodes.csv")
    for i in range(30):
        log.add(Episode(i + 1, 100 * (i + 1), 50.0, 100, 1.0 - i / 60, 0.8, 0, 1.0))
    log.close()
    RunRecord(
        status="finished", spec=SPEC, spec_digest=SPEC.digest, task="", algorithm="PPO", seed=0,
        action_range="symmetric", num_envs=1, steps=3000, steps_done=3000, checkpoint_every=1000,
        protocol=report.protocol, protocol_digest=report.protocol_digest, versions={},
    ).write(tmp_path)  # fmt: skip

    good("diagnose", "--explore", tmp_path)
    good("diagnose", "--explore", tmp_path)  # it follows from the run, and is replaced
    data = data_of(tmp_path / FILE)
    assert data["name"] == "PPO"
    assert data["policies"][0]["of"] == "observation"
    assert data["training"]["count"] == 30
    assert data["training"]["line"][1][-1] == pytest.approx(0.533, abs=0.02)
    assert data["regions"]["names"] == ["WD", *(f"OOD {i}" for i in range(1, 6))]
    expected = [region.normalised_regret for region in report.regions]
    assert data["regions"]["lines"]["PPO"] == pytest.approx(expected, rel=1e-5)
    assert data["plan"] == {"run": tmp_path.name, "algorithm": "PPO", "steps": "3,000", "seed": "0"}
    first = (tmp_path / FILE).read_bytes()
    write_explorer(tmp_path / FILE, load_run(tmp_path), report=run_report(tmp_path))
    assert (tmp_path / FILE).read_bytes() == first  # equal runs, equal bytes


def test_the_regret_over_the_episode_is_that_of_rollouts():
    subject = load_policy(fitted(SPEC), SPEC)
    over_time = facts(subject, episodes=16)["episode"]
    starts = draw.uniform(0, "explorer/starts", 16 * 3).reshape(16, 3)
    runs = rollouts(subject.policy, materialize(SPEC), starts)
    assert sum(over_time["mean"]) / SPEC.horizon == pytest.approx(runs.regret.mean(), abs=1e-5)
    team = SMESpec(team={"agents": [{"action_dim": 3}, {"action_dim": 1}], "reward": "team"})
    members = load_policy("constant", team)
    over_time = facts(members, episodes=16)["episode"]
    starts = draw.uniform(0, "explorer/starts", 16 * 8).reshape(16, 8)
    runs = rollouts(members.policy, materialize(team), starts)
    assert sum(over_time["mean"]) / team.horizon == pytest.approx(runs.regret.mean(), abs=1e-5)
    ended = load("Survival50", SMESpec)
    short = facts(load_policy(fitted(ended), ended), episodes=16)["episode"]
    assert short["running"][0] == 1.0
    assert short["mean"][-1] is None


def test_text_of_others_cannot_end_the_data():
    text = "</script><!-- & \u2028 ½"
    assert re.search("[<>&\u2028]", json_in_html({"name": text})) is None
    assert json.loads(json_in_html([text])) == [text]


def test_a_life_in_a_stream_has_no_page(tmp_path):
    with pytest.raises(OptionError, match="is a life in a stream"):
        write_explorer(tmp_path / "x.html", StreamSubject("life", None))
