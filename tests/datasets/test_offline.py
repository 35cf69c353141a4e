"""Training on a data set: short real runs, their records, and invalid arguments."""

import json
import sys

import numpy as np
import pytest
import torch

from sme_registry import EvaluationReport, SMESpec, materialize, save
from sme_registry.datasets import (
    DatasetRecipe,
    OfflinePolicy,
    SealedDataset,
    Transitions,
    collect,
    make_dataset,
    train_offline,
)
from sme_registry.datasets.documents import OfflineRecord
from sme_registry.datasets.offline import train_sealed
from sme_registry.errors import (
    DigestMismatchError,
    MissingDependencyError,
    OptionError,
    PolicyError,
    SpecError,
    UnknownNameError,
)
from tests.commands import good, refused
from tests.datasets.sets import TINY, transitions_of

PROTOCOL = {"states_per_region": 50}


@pytest.fixture(scope="module")
def transitions():
    return transitions_of()


def short(data, **changes):
    settings = {
        "algorithm": "bc",
        "steps": 40,
        "batch_size": 32,
        "evaluations": 2,
        "episodes": 3,
        "hyperparameters": {"hidden": [16, 16]},
        "spec": TINY,
        "protocol": PROTOCOL,
    }
    return train_offline(data, **{**settings, **changes})


def parts(result):
    return [array for layer in result.policy.layers for array in layer]


@pytest.mark.parametrize("algorithm", ["bc", "IQL"])
def test_the_same_seed_gives_the_same_policy_and_scores(transitions, algorithm):
    one, two = (short(transitions, algorithm=algorithm) for _ in range(2))
    for first, second in zip(parts(one), parts(two), strict=True):
        np.testing.assert_array_equal(first, second)
    assert one.record.evaluations == two.record.evaluations
    assert one.report == two.report
    other = short(transitions, algorithm=algorithm, seed=1)
    assert not np.array_equal(parts(one)[0], parts(other)[0])


def test_learners_see_what_the_agent_saw_and_the_report_has_its_cost():
    observed = {"distractors": 3, "mixing": "orthogonal"}
    spec = TINY.derive(safety={"tightness": 0.2}, observation=observed)
    data = transitions_of(spec)
    one, two = (short(data, spec=spec, algorithm="iql") for _ in range(2))
    assert one.record.evaluations == two.record.evaluations
    assert one.report.to_dict() == two.report.to_dict()
    assert one.policy.observation_dim == 7
    assert one.report.safety is not None
    assert one.report.observation is not None
    with pytest.raises(OptionError, match=r"must be \(600, 4\) for this task\."):
        short(data, spec=TINY)
    with pytest.raises(OptionError, match=r"must be \(600, 7\) for this task\."):
        short(transitions_of(), spec=spec)


def test_training_leaves_torch_as_it_was_and_progress_ends_at_the_last_step(transitions):
    torch.set_num_threads(2)
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    reports = []
    short(transitions, progress=lambda *arguments: reports.append(arguments))
    assert torch.equal(torch.rand(3), expected)
    assert torch.get_num_threads() == 2
    assert reports[-1][:2] == (40, 40)
    assert reports[-1][2].startswith("r̃ 0.")


def test_evaluations_are_evenly_spaced_and_the_last_is_of_the_policy_returned(transitions):
    result = short(transitions, steps=10, evaluations=3)
    assert [score.step for score in result.record.evaluations] == [3, 7, 10]
    last = result.record.evaluations[-1]
    similarities, rewards = by_hand(result, evaluation=2)
    assert last.similarity == pytest.approx(similarities.mean())
    assert last.similarity_sd == pytest.approx(similarities.std())
    assert last.episode_return == pytest.approx(rewards.sum() / 3)


def by_hand(result, evaluation):
    """Every step's r̃ and R of three episodes, from the task's own equations."""
    from sme_registry.task import draw

    task = materialize(TINY)
    s = draw.uniform(0, f"rollouts/{evaluation}/initial_state", 6).reshape(3, 2)
    similarities, rewards = [], []
    for t in range(TINY.horizon):
        clock = np.full((3, 1), t / TINY.horizon)
        seen = np.concatenate([s, clock, np.zeros((3, 1))], axis=1).astype(np.float32)
        a = result.policy(seen)
        similarities.append(task.similarity(s, a))
        rewards.append(task.step_reward(s, a))
        s = task.transition(s, a)
    return np.array(similarities), np.array(rewards)


def test_iql_surpasses_random_behaviour():
    noisy = transitions_of(nu="random", count=2000)
    result = short(
        noisy,
        algorithm="iql",
        steps=500,
        batch_size=128,
        hyperparameters={"hidden": [64], "learning_rate": 0.01},
    )
    assert result.record.improvement > 0.1


def test_a_folder_holds_what_was_returned_and_is_replaced_only_with_force(transitions, tmp_path):
    folder = tmp_path / "run"
    result = short(transitions, folder=folder)
    assert OfflineRecord.read(folder / "offline.json") == result.record
    assert EvaluationReport.read(folder / "evaluation.json") == result.report
    read = OfflinePolicy.load(folder / "policy.npz")
    observations = np.random.default_rng(0).random((5, 4), dtype=np.float32)
    np.testing.assert_array_equal(read(observations), result.policy(observations))
    assert result.record.dataset_digest == transitions.digest
    assert {"torch", "numpy", "python"} <= result.record.versions.keys()
    behaviour = result.record.behaviour
    assert behaviour.similarity == transitions.similarities.mean()
    assert behaviour.similarity_sd == transitions.similarities.std()
    assert behaviour.step_reward == transitions.step_rewards.mean()

    with pytest.raises(OptionError, match="already exists"):
        short(transitions, folder=folder)
    path = folder / "offline.json"
    path.write_text(path.read_text().replace(TINY.digest, SMESpec().digest))
    with pytest.raises(DigestMismatchError, match="spec_digest"):
        OfflineRecord.read(path)
    assert short(transitions, folder=folder, force=True, steps=2).record.steps == 2
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(OptionError, match=r"notes\.txt"):
        short(transitions, folder=folder, force=True)


def test_a_set_on_disk_provides_its_task_and_protocol(tmp_path):
    pytest.importorskip("minari")
    dataset = make_dataset(
        TINY, 0.5, transitions=100, protocol=PROTOCOL, name="sme/tiny-v0", folder=tmp_path
    )
    for data in (dataset, dataset.path):
        result = short(data, spec=None, protocol=None, steps=2)
        assert result.record.spec == TINY
        assert result.record.dataset == "sme/tiny-v0"
        assert result.record.recipe_digest == dataset.record.recipe_digest
        assert result.report.protocol.states_per_region == 50
    with pytest.raises(OptionError, match=r"the data set.s task is"):
        short(dataset, spec=SMESpec())


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"algorithm": "iq"}, UnknownNameError, "Did you mean 'iql'"),
        ({"steps": True}, OptionError, "steps=True"),
        ({"batch_size": 601}, OptionError, r"batch_size=601: must be an integer in \[1, 600\]"),
        ({"evaluations": 41}, OptionError, r"evaluations=41: must be an integer in \[1, 40\]"),
        ({"hyperparameters": {"expectile": 0.7}}, SpecError, "expectile=0.7: unknown field"),
        ({"algorithm": "iql", "hyperparameters": {"expectile": 1.0}}, SpecError, "expectile=1.0"),
        (
            {"hyperparameters": {"hidden": []}},
            SpecError,
            r"hidden=\[\]: must have at least 1 item, not 0\. ",
        ),
        ({"spec": SMESpec()}, OptionError, "observations of shape"),
        ({"spec": TINY.derive(seed=6)}, OptionError, "is not the task of the data set"),
        ({"spec": "Team2"}, SpecError, "team"),
        ({"protocol": "papr-v1"}, UnknownNameError, "paper-v1"),
    ],
)
def test_bad_input_is_refused(transitions, changes, error, message):
    with pytest.raises(error, match=message):
        short(transitions, **changes)


def test_other_data_is_refused():
    with pytest.raises(OptionError, match="must be a data set"):
        short([1, 2, 3])
    with pytest.raises(UnknownNameError, match="is neither the id of a data set"):
        short("sme/nothing-v0", spec=None)


def test_numbers_that_are_not_finite_are_refused_and_a_training_that_diverges_says_so(transitions):
    columns = transitions.columns()
    rewards = columns["rewards"]
    columns["rewards"] = np.where(np.arange(600) == 7, np.nan, rewards)
    with pytest.raises(OptionError, match="rewards: contains NaN"):
        short(Transitions(**columns))
    columns["rewards"] = rewards + 1e30  # whose square no float32 holds
    with pytest.raises(PolicyError, match="diverged before step"):
        short(Transitions(**columns), algorithm="iql")


def test_without_torch_it_says_what_to_install(transitions, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependencyError, match=r"\[offline\]"):
        short(transitions)


SHORT = ["--steps", "5", "--set", "batch_size=16", "--set", "hidden=[8]"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    pytest.importorskip("minari")
    place = tmp_path_factory.mktemp("sets")
    make_dataset(
        TINY, 0.5, transitions=60, protocol={"states_per_region": 20}, name="tiny-v0", folder=place
    )
    return place


@pytest.mark.parametrize("algorithm", ["bc", "iql"])
def test_train_and_evaluate_from_the_command_line(folder, tmp_path, algorithm, monkeypatch):
    out, task = tmp_path / "run", tmp_path / "tiny.json"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    named = ("train", "--data", "tiny-v0", "-a", algorithm)
    assert "improvement" in good(*named, "--out", out, *SHORT).stdout
    names = {path.name for path in out.iterdir()}
    assert names >= {"offline.json", "policy.npz", "evaluation.json"}
    save(TINY, task, name="Tiny")
    shown = good("evaluate", out / "policy.npz", task, "--protocol", "quick-v1", "--json")
    assert json.loads(shown.stdout)["policy"] == "policy"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tiny-v1"], "is neither the id of a data set"),
        (["tiny-v0", "--set", "expectil=1"], "unknown field"),
        (["tiny-v0", "--resume"], "--resume: is not for --data"),
    ],
)
def test_invalid_input_is_refused_and_writes_nothing(
    folder, tmp_path, arguments, message, monkeypatch
):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    out = tmp_path / "run"
    assert message in refused("train", "--data", *arguments, "--out", out)
    assert not out.exists()


SEALED = DatasetRecipe.from_dict(
    {
        "spec": TINY.to_dict(),
        "behaviours": [{"kind": "mixture", "nu": 0.5}],
        "transitions": 200,
    }
)
BRIEF = {"steps": 20, "batch_size": 32, "hyperparameters": {"hidden": [16]}}


@pytest.fixture(scope="module")
def sealed():
    return SealedDataset.collect(SEALED)


@pytest.mark.parametrize("algorithm", ["bc", "iql"])
def test_the_policy_is_that_of_the_same_rows_with_their_task(sealed, algorithm):
    rows = collect(SEALED, materialize(TINY))
    protocol = {"states_per_region": 50}
    known = train_offline(
        rows, algorithm=algorithm, spec=TINY, protocol=protocol, evaluations=1, episodes=1, **BRIEF
    ).policy
    hidden = train_sealed(sealed, algorithm=algorithm, **BRIEF)
    for mine, theirs in zip(hidden.layers, known.layers, strict=True):
        for one, other in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(one, other)
    about = {"algorithm": algorithm, "seed": 0, "steps": 20, "dataset_digest": sealed.digest}
    assert hidden.about == about  # and no digest of a spec


def test_the_progress_is_reported_of_all_steps_and_faults_are_named(sealed):
    calls = []
    longer = {**BRIEF, "steps": 60}
    train_sealed(sealed, algorithm="bc", progress=lambda *done: calls.append(done), **longer)
    assert calls == [(50, 60), (60, 60)]
    with pytest.raises(UnknownNameError):
        train_sealed(sealed, algorithm="ppo")
    with pytest.raises(OptionError, match="batch_size"):
        train_sealed(sealed, batch_size=201)


def test_the_command_writes_a_policy(sealed, tmp_path):
    folder, target = sealed.write("sealed/autumn/deep-0-v0", tmp_path), tmp_path / "deep-0.npz"
    command = ["train", "--data", folder, "-o", target, "-n", "20", "--set", "batch_size=32"]
    good(*command, "--set", "hidden=[16]")
    policy, expected = OfflinePolicy.load(target), train_sealed(sealed, **BRIEF)
    np.testing.assert_array_equal(
        policy(sealed.observations[:8]), expected(sealed.observations[:8])
    )
    assert str(target) in refused(*command).replace("\n", "")
    assert "--protocol: is of" in refused(*command, "--force", "--protocol", "quick-v1")
