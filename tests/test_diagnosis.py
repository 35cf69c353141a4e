"""The diagnosis: policies with a fault that is known get that fault as their diagnosis, and no
other; what cannot be told from the evidence is not told."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from sme_registry import SMESpec, materialize
from sme_registry.cli import app
from sme_registry.diagnosis import (
    Diagnosis,
    Subject,
    diagnose,
    measure,
    of_cell,
    of_policy,
    of_run,
    rules,
)
from sme_registry.diagnosis.report import Capacity, Training
from sme_registry.diagnosis.subject import Log
from sme_registry.errors import (
    DigestMismatchError,
    OptionError,
    PolicyError,
    SpecError,
    UnknownNameError,
)
from sme_registry.evaluation.references import reference_policy

SPEC = SMESpec(horizon=20)
DEEP = SMESpec(horizon=20, complexity=10, seed=1)
FAULTS = [
    "action channels", "state region", "outside the cube", "constant offset", "reaction",
    "only linear", "saturation", "noise", "clock",
]  # fmt: skip


def optimum(spec: SMESpec) -> Any:
    """π* of observations."""
    return reference_policy("optimal", spec)


def diagnosed(policy: Any, spec: SMESpec = SPEC, **options: Any) -> Diagnosis:
    settings = {"states": 2048, "episodes": 8, **options}
    return diagnose(of_policy(policy, spec), **settings)


def stands_out(found: Diagnosis) -> set[str]:
    return {f.question for f in found.findings if f.kind == "where" and f.answer == "yes"}


def one_channel_constant(observation: Any) -> Any:
    a = optimum(SPEC)(observation)
    a[:, 2] = 0.5
    return a


def inside_only(observation: Any) -> Any:
    s = observation[:, :8]
    inside = ((s >= 0) & (s <= 1)).all(axis=1, keepdims=True)
    return np.where(inside, optimum(SPEC)(observation), 0.5)


def left_half_only(observation: Any) -> Any:
    return np.where(observation[:, 4:5] < 0.5, optimum(SPEC)(observation), 0.5)


def near_the_centre_only(observation: Any) -> Any:
    near = np.abs(observation[:, :8] - 0.5).max(axis=1, keepdims=True) < 0.44
    return np.where(near, optimum(SPEC)(observation), 0.5)


def with_offset(observation: Any) -> Any:
    return optimum(SPEC)(observation) + 0.15


def shrunk(observation: Any) -> Any:
    return 0.5 + 0.3 * (optimum(SPEC)(observation) - 0.5)


def saturated(observation: Any) -> Any:
    return (optimum(SPEC)(observation) > 0.5).astype(float)


def clocked(observation: Any) -> Any:
    return optimum(SPEC)(observation) + 0.4 * (observation[:, 8:9] - 0.5)


class Noisy:
    def __init__(self) -> None:
        self.generator = np.random.default_rng(0)

    def __call__(self, observation: Any) -> Any:
        a = optimum(SPEC)(observation)
        return a + 0.1 * self.generator.standard_normal(a.shape)


@pytest.mark.parametrize(
    ("policy", "fault", "words"),
    [
        # Most of the error is then that this channel does not react.
        (one_channel_constant, ["action channels", "reaction"], "1 of 4"),
        (inside_only, ["outside the cube"], "OOD 5"),
        (left_half_only, ["state region"], "State channel 5"),
        (
            near_the_centre_only,
            ["state region", "outside the cube", "reaction"],
            "The distance from the cube's centre",
        ),
        (with_offset, ["constant offset"], "+0.1"),
        (shrunk, ["reaction"], "slope of a on a* is 0.30"),
        (saturated, ["saturation"], "100% of action entries"),
        (clocked, ["clock"], "t/T"),
        (Noisy(), ["noise"], "asked again"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_policy_with_one_known_fault_is_said_to_have_it(
    policy: Any, fault: list[str], words: str
) -> None:
    found = diagnosed(policy)
    assert stands_out(found) & set(FAULTS) == set(fault), found.headline
    assert words in found.finding(fault[0]).text


def test_the_optimum_has_no_fault_and_nothing_to_explain() -> None:
    found = diagnosed(optimum(DEEP), DEEP)
    assert {f.answer for f in found.findings} == {"no"}
    assert found.headline.startswith("Solved")
    assert found.numbers.own.regret == 0.0


def test_a_linear_policy_of_a_deep_task_has_only_the_linear_part() -> None:
    found = diagnosed(reference_policy("linear", DEEP), DEEP)
    form = found.numbers.form
    assert "only linear" in stands_out(found)
    assert form.learnt_linear == pytest.approx(1.0, abs=0.05)
    assert form.learnt_rest == pytest.approx(0.0, abs=0.05)
    assert form.beyond_linear > 0.15


def test_a_constant_where_r_min_hides_what_it_would_earn_fails_by_sparsity() -> None:
    spec = SPEC.derive(r_min=0.75)
    found = diagnosed(reference_policy("constant", spec), spec)
    signal = found.numbers.on_policy.signal
    assert found.headline.startswith("No better than a constant action")
    assert found.finding("sparsity").answer == "yes"
    assert signal.hidden >= 0.25
    assert signal.paid + signal.hidden + signal.flat == pytest.approx(1.0)
    same = diagnosed(reference_policy("constant", SPEC), SPEC)
    assert same.finding("sparsity").answer == "no"
    assert same.numbers.own.normalised == found.numbers.own.normalised


def test_what_is_charged_to_the_channels_adds_up_to_the_regret() -> None:
    numbers = diagnosed(with_offset).numbers
    assert sum(c.regret for c in numbers.channels) == pytest.approx(numbers.own.regret)
    assert np.mean([c.error for c in numbers.channels]) == pytest.approx(numbers.own.error)


def test_the_squared_error_is_divided_up_whole_and_as_it_was_made() -> None:
    def made(observation: Any) -> Any:  # within [0, 1], so nothing is clipped
        return 0.2 + 0.5 * optimum(SPEC)(observation)

    numbers = diagnosed(made).numbers
    form, optimal = numbers.form, optimum(SPEC)
    s = np.random.default_rng(0).random((20_000, 10), dtype=np.float32)
    a = optimal(s)
    offset = ((0.2 - 0.5 * a).mean(axis=0) ** 2).mean()
    scale = 0.25 * a.var(axis=0).mean()
    assert form.offset + form.scale + form.residual == pytest.approx(1.0)
    assert form.offset == pytest.approx(offset / (offset + scale), abs=0.01)
    assert form.residual == pytest.approx(0.0, abs=1e-6)
    assert form.gain == pytest.approx(0.5, abs=0.01)


def test_scores_and_shells_are_those_of_evaluate() -> None:
    from sme_registry import evaluate

    report = evaluate(shrunk, SPEC, {"states_per_region": 2048}, name="it")
    found = diagnosed(shrunk).numbers
    assert found.own.error == pytest.approx(report.regions[0].mae)
    for shell, region in zip(found.shells, report.regions, strict=True):
        assert shell.policies[""].normalised == pytest.approx(region.normalised_regret, abs=0.02)


def test_the_numbers_are_the_same_each_time_and_others_with_another_seed() -> None:
    assert diagnosed(clocked) == diagnosed(clocked)
    assert diagnosed(clocked, seed=1).numbers != diagnosed(clocked).numbers


def test_payouts_over_k_steps_mix_rewards_and_no_single_run_says_if_that_is_why() -> None:
    spec = SPEC.derive(k=5, horizon=50)
    found = diagnosed(Noisy(), spec.derive(k=5), episodes=64)
    credit = found.numbers.on_policy.credit_random
    assert credit == pytest.approx(1 / 5, abs=0.05)
    assert diagnosed(Noisy()).numbers.on_policy.credit_random == pytest.approx(1.0)
    halves = diagnosed(reference_policy("constant", spec), spec)
    assert halves.finding("credit assignment").answer == "cannot tell"
    assert "--against" in halves.finding("credit assignment").text


def test_rewards_of_an_episode_that_D_ended_unpaid_are_credited_with_nothing() -> None:
    reward = np.array([[1.0, 0.2], [0.5, 0.9], [0.0, 0.4], [0.0, 0.6]])
    payout = np.array([[0.0, 0.0], [0.0, 1.1], [0.0, 0.0], [0.0, 1.0]])
    alive = np.array([[1, 1], [1, 1], [0, 1], [0, 1]], bool)
    paid = np.array([[0, 0], [0, 1], [0, 0], [0, 1]], bool)
    nothing = np.zeros((4, 2))
    found = measure.Trace(
        np.zeros((4, 2, 1)), nothing, nothing, reward, payout, alive, paid, np.array([True, False])
    )
    by_hand = np.corrcoef([0.2, 0.9, 0.4, 0.6], [1.1, 1.1, 1.0, 1.0])[0, 1] ** 2
    assert measure._credit(found) == pytest.approx(by_hand)


def test_a_task_that_ends_episodes_early_is_seen_by_survival() -> None:
    spec = SPEC.derive(D=0.9)
    found = diagnosed(shrunk, spec)
    assert found.finding("survival").answer == "yes"
    assert found.numbers.on_policy.mean_length < 5
    assert found.numbers.on_policy.alive[-1] < 0.1 or len(found.numbers.on_policy.alive) < 10
    assert diagnosed(optimum(spec), spec).numbers.on_policy.mean_length == spec.horizon


@pytest.mark.parametrize(
    ("name", "regret", "exploration", "budget"),
    [
        ("learns and goes on", np.linspace(0.95, 0.4, 100), "no", "yes"),
        ("learns and levels off", np.r_[np.linspace(0.95, 0.4, 30), np.full(70, 0.4)], "no", "no"),
        ("learns and falls back", np.r_[np.full(50, 0.4), np.full(50, 0.95)], "no", "no"),
        ("never leaves a constant", np.full(100, 0.93), "cannot tell", "cannot tell"),
    ],
)
def test_what_a_log_says_of_exploration_and_budget(
    name: str, regret: Any, exploration: str, budget: str
) -> None:
    log = Log("episodes", np.arange(1, 101) * 20.0, regret, regret >= 1, np.zeros(100))
    subject = of_policy(reference_policy("constant", SPEC), SPEC)
    subject = Subject("it", SPEC, subject.policy, {}, log)
    found = diagnose(subject, states=256, episodes=8)
    assert found.finding("exploration").answer == exploration
    assert found.finding("budget").answer == budget
    if name == "learns and falls back":
        assert "It was better before" in found.finding("budget").text
    assert isinstance(found.numbers.training, Training)


def test_where_random_actions_are_never_paid_and_nothing_was_learnt_it_is_exploration() -> None:
    spec = SPEC.derive(r_min=0.9, action_dim=8)
    log = Log("episodes", np.arange(1, 31) * 20.0, np.ones(30), np.ones(30), np.zeros(30))
    policy = of_policy(reference_policy("constant", spec), spec).policy
    found = diagnose(Subject("it", spec, policy, {}, log), states=256, episodes=8)
    assert found.finding("exploration").answer == "yes"
    assert "100% of episodes had no reward" in found.finding("sparsity").text


@pytest.mark.parametrize(
    ("fitted", "held_out", "capacity", "dimension"),
    [
        (0.05, 0.06, "no", "no"),
        (0.95, 0.96, "yes", "cannot tell"),
        (0.05, 0.95, "no", "yes"),
        (0.6, 0.65, "cannot tell", "cannot tell"),
    ],
)
def test_the_probe_separates_capacity_from_too_few_states(
    fitted: float, held_out: float, capacity: str, dimension: str
) -> None:
    numbers = diagnosed(reference_policy("constant", SPEC)).numbers
    probe = Capacity(
        layers=(10, 4), states=1000, gradient_steps=1, fitted=fitted, held_out=held_out, seconds=0
    )
    found = rules.findings(numbers.model_copy(update={"capacity": probe}), SPEC)
    answers = {f.question: f.answer for f in found}
    assert answers["capacity"] == capacity
    assert answers["dimension"] == dimension


def test_the_probe_fits_what_a_network_can_be_and_not_what_it_cannot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch = pytest.importorskip("torch")
    from sme_registry.diagnosis import networks
    from sme_registry.training.numpy_policy import Perceptron

    def layers(*widths: int) -> Perceptron:
        pairs = itertools.pairwise(widths)
        made = [
            (np.zeros(pair, np.float32), np.zeros(pair[1], np.float32), np.tanh) for pair in pairs
        ]
        return Perceptron((*made[:-1], (*made[-1][:2], None)))

    monkeypatch.setattr(networks, "GRADIENT_STEPS", 300)
    monkeypatch.setattr(networks, "_FEWEST_STATES", 16)
    task = materialize(SPEC)
    torch.manual_seed(5)
    state = torch.random.get_rng_state()
    wide = networks.capacity(layers(10, 64, 4), task, 5000, 0, lambda done: None)
    narrow = networks.capacity(layers(10, 1, 4), task, 5000, 0, lambda done: None)
    few = networks.capacity(layers(10, 64, 64, 4), materialize(DEEP), 1, 0, lambda done: None)
    assert wide.layers == (10, 64, 4)
    assert wide.held_out < 0.2 < 0.6 < narrow.fitted
    assert few.states == 16
    assert few.fitted < 0.5 * few.held_out
    assert torch.equal(torch.random.get_rng_state(), state)


def test_one_changed_axis_decides_its_cause_and_two_decide_nothing() -> None:
    k5 = SPEC.derive(k=5)
    better, worse = of_policy(shrunk, SPEC), of_policy(saturated, k5)
    found = diagnose(worse, against=better, states=256, episodes=8)
    assert found.comparison is not None
    assert found.comparison.spec_fields == {"k": (5, 1)}
    gap = found.comparison.differences[0]
    assert gap.here - gap.there == pytest.approx(
        found.numbers.own.normalised - diagnosed(shrunk, states=256).numbers.own.normalised
    )
    assert found.finding("credit assignment").answer == (
        "yes" if gap.here - gap.there >= 0.1 else "no"
    )
    assert "Only k differs" in found.finding("credit assignment").text
    two = of_policy(saturated, k5.derive(r_min=0.5))
    found = diagnose(two, against=better, states=256, episodes=8)
    assert found.finding("credit assignment").answer == "cannot tell"


def test_beside_a_run_that_has_not_learnt_either_an_axis_is_not_cleared() -> None:
    def credit(policy: Any, other: Any, k: int = 100) -> tuple[str, str]:
        here, there = SPEC.derive(k=k, horizon=100), SPEC.derive(k=101 - k, horizon=100)
        found = diagnose(
            of_policy(policy, here), against=of_policy(other, there), states=256, episodes=8
        ).finding("credit assignment")
        return found.answer, found.text

    nothing, little = reference_policy("constant", SPEC), shrunk
    answer, text = credit(nothing, nothing)
    assert answer == "cannot tell"
    assert "Only k differs" in text
    assert "has learnt next to nothing itself (ν from 0.9)" in text
    assert "train both longer" in text
    # Any of these decides: the run itself has learnt, the other has, k = 1 needs no other run.
    assert credit(little, nothing)[0] == "no"
    assert credit(little, little)[0] == "no"
    assert credit(nothing, little)[0] == "yes"
    assert credit(nothing, nothing, k=1) == ("no", "k = 1: every action is paid for itself.")


def test_what_cannot_be_diagnosed_is_refused_in_a_sentence(tmp_path: Path) -> None:
    team = SMESpec(team={"agents": [{"action_dim": 2}, {"action_dim": 2}], "reward": "team"})
    with pytest.raises(SpecError, match="one agent"):
        of_policy(shrunk, team)
    with pytest.raises(OptionError, match="no such folder"):
        of_run(tmp_path / "absent")
    with pytest.raises(OptionError, match=r"holds no run\.json"):
        of_run(tmp_path)
    with pytest.raises(OptionError, match="no study"):
        of_cell(tmp_path, "abcdef")
    with pytest.raises(OptionError, match="states=63"):
        diagnosed(shrunk, states=63)
    with pytest.raises(OptionError, match="episodes=True"):
        diagnosed(shrunk, episodes=True)
    with pytest.raises(PolicyError, match="NaN"):
        diagnosed(lambda observation: np.full((len(observation), 4), np.nan))


# --- runs, cells and the command ----------------------------------------------------------------


def sme(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def refused(*arguments: str | Path) -> str:
    result = sme(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ")
    assert "Traceback" not in result.output
    return result.stderr


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short training of PPO, as `sme train` leaves it."""
    pytest.importorskip("stable_baselines3")
    from sme_registry.training import train

    folder = tmp_path_factory.mktemp("runs") / "short"
    protocol = {"states_per_region": 100}
    train(SPEC, algorithm="PPO", steps=100, folder=folder, protocol=protocol, progress=False)
    return folder


def test_a_run_is_diagnosed_with_its_log_and_what_it_still_tries(run: Path) -> None:
    found = diagnose(of_run(run), states=256, episodes=8)
    assert found.plan["algorithm"] == "PPO"
    assert found.note == ""
    log, spread = found.numbers.training, found.numbers.exploration_sd
    assert log is not None
    assert log.rows == 102  # 2,048 steps of 20
    assert spread is not None
    assert all(0.2 < sd < 0.5 for sd in spread)  # SD 1 in [−1, 1], clipped


def test_a_run_that_was_stopped_is_diagnosed_from_its_checkpoint(run: Path, tmp_path: Path) -> None:
    import shutil

    stopped = tmp_path / "stopped"
    shutil.copytree(run, stopped)
    if not (stopped / "checkpoint.zip").exists():
        (stopped / "model.zip").rename(stopped / "checkpoint.zip")
    else:
        (stopped / "model.zip").unlink()
    assert "checkpoint after" in of_run(stopped).note
    (stopped / "checkpoint.zip").unlink()
    assert "neither model.zip nor checkpoint.zip" in refused("diagnose", stopped)


def test_the_command_writes_a_page_its_data_and_its_figures(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    from sme_registry.diagnosis import networks

    monkeypatch.setattr(networks, "GRADIENT_STEPS", 100)
    options = ("--states", "256", "--episodes", "8")
    result = sme("diagnose", run, "--out", tmp_path / "d", "--probe-capacity", *options)
    assert result.exit_code == 0, result.output
    assert "Why" in result.stdout
    page = (tmp_path / "d" / "diagnosis.md").read_text()
    figures = sorted(path.name for path in (tmp_path / "d").glob("*.png"))
    assert len(figures) == 5
    assert all(f"]({name})" in page for name in figures)
    read = Diagnosis.read(tmp_path / "d" / "diagnosis.json")
    assert read.numbers.capacity is not None
    assert read.numbers.capacity.layers == (10, 64, 64, 4)
    assert all(finding.text.replace("|", r"\|") in page for finding in read.findings)
    assert "is there already" in refused("diagnose", run, "--out", tmp_path / "d")
    again = sme("diagnose", run, "--out", tmp_path / "d", "--force", "--json", *options)
    assert json.loads(again.stdout)["name"] == "short"


def test_a_diagnosis_that_was_changed_is_refused(tmp_path: Path) -> None:
    plain = diagnosed(shrunk, states=256).to_dict()
    plain["spec"]["seed"] = 7
    (tmp_path / "diagnosis.json").write_text(json.dumps(plain))
    with pytest.raises(DigestMismatchError, match="diagnose the run again"):
        Diagnosis.read(tmp_path / "diagnosis.json")


def test_the_command_takes_any_policy_with_its_task(tmp_path: Path) -> None:
    options = ("--states", "256", "--episodes", "8", "--json")
    result = sme("diagnose", "linear", "--task", "Default", "--set", "complexity=10", *options)
    assert result.exit_code == 0, result.output
    found = Diagnosis.from_dict(json.loads(result.stdout))
    assert found.spec.complexity == 10
    assert "only linear" in stands_out(found)
    against = sme("diagnose", "linear", "-t", "Default", "--against", "constant", *options)
    assert json.loads(against.stdout)["comparison"]["spec_fields"] == {}
    assert "--task Default" in refused("diagnose", "linear")
    assert "needs --task" in refused("diagnose", tmp_path, "--set", "k=1")
    assert "Give one of them" in refused("diagnose", tmp_path, "--cell", "a", "--task", "Default")


def test_a_cell_of_a_study_is_found_by_the_first_digits_of_its_key(tmp_path: Path) -> None:
    from sme_registry.spec.study import Cell
    from sme_registry.studies.engine.cell import run_cell

    cells = [
        Cell(
            spec=SPEC, uses=uses, hyperparameters={}, action_range="symmetric", seed=0, steps=40,
            evaluations=2, evaluation_episodes=1, protocol={"states_per_region": 100},
        )
        for uses in ("reference:linear", "reference:constant", "TD3")
    ]  # fmt: skip
    keys = [cell.digest.removeprefix("sha256:") for cell in cells]
    (tmp_path / "cells").mkdir()
    for cell, key in zip(cells, keys, strict=True):
        result = run_cell(cell, model_path=tmp_path / "models" / f"{key}.zip")
        (tmp_path / "cells" / f"{key}.json").write_text(json.dumps(result.to_dict()))
    linear = of_cell(tmp_path, keys[0][:12])
    assert linear.log is not None
    assert linear.log.source == "evaluations"
    assert linear.plan["algorithm"] == "reference:linear"
    options = ("--states", "256", "--episodes", "8", "--json")
    trained = sme("diagnose", tmp_path, "--cell", keys[2], "--against", keys[1][:9], *options)
    assert trained.exit_code == 0, trained.output
    comparison = json.loads(trained.stdout)["comparison"]
    assert comparison["plan_fields"] == {"algorithm": ["TD3", "reference:constant"]}
    assert "0 of 3" in refused("diagnose", tmp_path, "--cell", "0123456789")
    with pytest.raises(UnknownNameError, match="6 or more digits"):
        of_cell(tmp_path, "")
    assert "say which cell" in refused("diagnose", tmp_path)
    (tmp_path / "models" / f"{keys[2]}.zip").unlink()
    without = refused("diagnose", tmp_path, "--cell", keys[2])
    assert "What has finished is not run again" in without
    assert "in a new folder, with --keep-models" in without
    (tmp_path / "cells" / f"{keys[1]}.json").write_text("{}")
    assert "no result of a cell" in refused("diagnose", tmp_path, "--cell", keys[1])


def test_without_matplotlib_there_are_words_and_no_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else found(name)
    )
    options = ("--states", "256", "--episodes", "8", "--out", str(tmp_path))
    result = sme("diagnose", "constant", "--task", "Default", *options)
    assert result.exit_code == 0, result.output
    assert "pip install" in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["diagnosis.json", "diagnosis.md"]


def test_importing_the_diagnosis_draws_in_neither_torch_nor_matplotlib() -> None:
    import subprocess

    code = (
        "import sys, sme_registry.diagnosis.figures; "
        "print([m for m in ('torch', 'matplotlib', 'stable_baselines3') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
