"""Lives in which nobody learns: their expected dynamic regret, and reference agents."""

import numpy as np
import pytest

import sme_registry
from sme_registry import materialize
from sme_registry.errors import OptionError, PolicyError, SMEError, UnknownNameError
from sme_registry.evaluation import (
    StreamReport,
    dynamic_regret,
    evaluate,
    evaluate_stream,
    expected_regret,
    reference_policy,
    reference_regret,
)
from sme_registry.evaluation.report import as_text
from tests.evaluation.streams import SPEC, TWICE, half, network, stream_of

PROTOCOL = {"states_per_region": 50, "epsilons": [0.5, 1.0]}
GATED = SPEC.derive(seed=1, k=5, r_min=0.3)
TURN = {"rotation": 2.0, "increments": 3}


def by_visit(life):
    return [visit.dynamic_regret for visit in life.visits]


def test_a_constant_action_costs_its_regret_in_uniform_states():
    life = expected_regret(["constant"], stream_of(GATED), episodes=2000)
    s = np.random.default_rng(0).random((50_000, SPEC.state_dim))
    expected = materialize(GATED).regret(s, half(s)).mean()
    assert life.online_regret == pytest.approx(expected, rel=0.01)
    assert life.dynamic_regret == pytest.approx(50 * expected, rel=0.01)


@pytest.mark.parametrize(
    "stream",
    [
        stream_of(SPEC, GATED, SPEC.derive(seed=2), steps=60, drift=TURN, cycles=2),
        stream_of(SPEC, GATED, observes_phase=True),
        stream_of(SPEC, SPEC.derive(seed=1, D=0.1), steps=400),
        stream_of(SPEC, SPEC.derive(seed=1), steps=205, switch="step"),
    ],
    ids=["drift", "observes_phase", "early termination", "switch within an episode"],
)
@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_expected_regret_is_the_mean_regret_of_lives(stream):
    visits = stream.cycles * len(stream.phases)
    policies = [network(v, stream.observation_dim) for v in range(visits)]
    expected = expected_regret(policies, stream, episodes=2000)
    env = sme_registry.make(stream)
    lives = np.array([played(env, policies, seed)[0] for seed in range(25)])
    errors = lives.std(axis=0, ddof=1) / 5
    assert (np.abs(by_visit(expected) - lives.mean(axis=0)) < 4 * errors).all()
    assert (errors < 0.05 * lives.mean(axis=0)).all()  # so that another task is another number
    assert expected.steps == stream.steps
    assert expected.dynamic_regret == pytest.approx(sum(by_visit(expected)))


def played(env, policies, seed):
    """Regret and steps, `[2, V]`, of a life in the environment, each visit with its policy."""
    stream = env.unwrapped.stream
    found = np.zeros((2, len(policies)))
    observation, _ = env.reset(seed=seed)
    visit, ended = 0, False
    for lifetime in range(stream.steps):
        if ended or stream.switch == "step":
            phase = stream.segments[stream.times.segment_at(lifetime)].phase
            visit = lifetime // stream.cycle_steps * len(stream.phases) + phase
        action = policies[visit](observation[None])[0].astype(np.float32)
        observation, _, terminated, truncated, info = env.step(action)
        found[:, visit] += info["regret"], 1
        assert info["phase"] == visit % len(stream.phases)
        if ended := terminated or truncated:
            observation, _ = env.reset()
    return found


@pytest.mark.parametrize("switch", ["episode", "step"])
@pytest.mark.parametrize("steps", [4, 14, 20])
def test_a_visit_has_the_steps_in_which_its_phase_is_in_force(steps, switch):
    specs = [SPEC.derive(seed=seed) for seed in range(3)]
    stream = stream_of(*specs, steps=steps, cycles=2, switch=switch)
    regret = np.linspace(0.0, 1.0, 6)
    life = expected_regret(regret.tolist(), stream)
    found = np.zeros((2, 6))
    found[:, : len(life.visits)] = [visit.steps for visit in life.visits], by_visit(life)
    _, steps = played(sme_registry.make(stream), [half] * 6, 0)
    np.testing.assert_allclose(found, [steps, steps * regret])
    assert life.steps == stream.steps


def test_a_number_is_the_online_regret_of_a_visit():
    life = expected_regret([0.5, 0.25, 0.0, 1.0], TWICE)
    assert by_visit(life) == [25.0, 12.5, 0.0, 50.0]
    assert life.cumulative_regret == (25.0, 37.5, 37.5, 87.5)
    mixed = expected_regret([0.5, network(0), network(1), 1.0], TWICE, episodes=50)
    once = stream_of(SPEC, SPEC.derive(seed=1))
    alone = expected_regret([network(1), network(0)], once, episodes=50)
    assert by_visit(mixed)[1:3] == by_visit(alone)[::-1]


def test_a_policy_runs_once_in_each_piece_and_is_repeatable():
    calls = []

    def counted(observations):
        calls.append(len(observations))
        return half(observations)

    once = expected_regret([counted] * 4, TWICE, episodes=10)
    assert sum(calls) == 10 * SPEC.horizon
    assert by_visit(once)[2] == by_visit(once)[0]
    assert once == expected_regret(["constant"] * 4, TWICE, episodes=10)
    assert once != expected_regret(["constant"] * 4, TWICE, episodes=10, seed=1)


# Reference agents


def test_reference_agents_have_no_regret_in_the_tasks_of_which_they_are_the_optimum():
    stream = stream_of(SPEC, GATED, SPEC.derive(r_min=0.5), drift=TURN, cycles=2)
    found = reference_regret(stream, episodes=300)
    assert found.keys() == {"frozen_optimum", "fresh_optimum", "constant"}
    assert found["fresh_optimum"].dynamic_regret == 0.0
    frozen = by_visit(found["frozen_optimum"])
    optimum = reference_policy("optimal", SPEC)
    acting = by_visit(expected_regret([optimum] * 6, stream, episodes=300))
    assert frozen[0] == frozen[3] == 0.0
    assert acting[0] < 1e-4  # of rounded observations
    for v in (1, 2, 4, 5):
        assert frozen[v] == acting[v] > 1.0
    half_life = expected_regret(["constant"] * 6, stream, episodes=300)
    assert found["constant"] == half_life


def test_the_optimum_of_a_drifting_phase_is_that_of_its_last_task():
    stream = stream_of(SPEC, drift=TURN)
    frozen = reference_regret(stream, episodes=300)["frozen_optimum"]
    last = reference_policy("optimal", SPEC.derive(rotation=2.0 * 2 / 3))
    assert frozen == expected_regret([last], stream, episodes=300)
    assert frozen.dynamic_regret > 1.0


def test_a_frozen_agent_has_its_own_first_visit_and_needs_its_training():
    training = dynamic_regret(TWICE, [50, 100], [0.75, 0.1], 50)
    frozen = network(0)
    found = reference_regret(TWICE, frozen=frozen, training=training, episodes=50)["frozen_agent"]
    acting = expected_regret([frozen] * 4, TWICE, episodes=50)
    assert by_visit(found)[0] == 37.5 != by_visit(acting)[0]
    assert found.visits[1:] == acting.visits[1:]
    with pytest.raises(OptionError, match="frozen, training: must be given together"):
        reference_regret(TWICE, frozen="linear")
    late = dynamic_regret(TWICE, [60], [0.5], 10)
    with pytest.raises(OptionError, match="training: has no steps in visit 0"):
        reference_regret(TWICE, frozen="linear", training=late)
    with pytest.raises(UnknownNameError, match=r"frozen: .*'linear'"):
        reference_regret(TWICE, frozen="linaer", training=training)


def test_a_report_has_the_regret_of_reference_agents(tmp_path):
    plain = evaluate_stream(["linear"] * 4, TWICE, PROTOCOL, name="agent")
    assert len(plain.tables()) == 2
    assert "reference_regret" not in plain.to_dict()
    training = dynamic_regret(TWICE, [50, 100, 150], [0.75, 0.125, 0.5], 50)
    references = reference_regret(TWICE, episodes=50)
    untrained = plain.with_reference_regret(references)
    assert "constant ½" in as_text(untrained.tables()[2])
    fresh = [evaluate("linear", phase.spec, PROTOCOL) for phase in TWICE.phases]
    report = untrained.with_dynamic_regret(training).with_fresh(fresh, [0.5, 0.25])
    life = report.reference_regret["fresh_agents"]
    assert [visit.online_regret for visit in life.visits] == [0.5, 0.25, 0.5, 0.25]
    assert report.reference_regret["constant"] == references["constant"]
    assert StreamReport.read(report.write(tmp_path / "stream.json")) == report

    text = str(report)
    (steps,) = (line.split() for line in text.splitlines() if line.lstrip().startswith("steps"))
    assert steps == ["steps", "150", *["200"] * 4]  # sums over different steps are no comparison
    for value in (0.75, -0.5, references["frozen_optimum"].visits[1].online_regret):
        assert f" {value:.3f}" in text
    assert f"{references['constant'].dynamic_regret:,.1f}" in text
    assert all(label in text for label in ("fresh agent in each phase", "learning transfer"))


@pytest.mark.parametrize(
    ("life", "fields", "error", "message"),
    [
        (["constant"], {}, OptionError, "life=1 of them: must be 4"),
        ([0.5, 1.5, 0.5, 0.5], {}, OptionError, r"life\[1\]=1.5: must be"),
        ([0.5, "linaer", 0.5, 0.5], {}, UnknownNameError, r"life\[1\]: .*'linear'"),
        ([0.5, lambda o: o, 0.5, 0.5], {}, PolicyError, "policy 'policy'"),
        (["constant"] * 4, {"episodes": 0}, OptionError, "episodes=0"),
    ],
)
def test_bad_input_is_refused(life, fields, error, message):
    with pytest.raises(error, match=message):
        expected_regret(life, TWICE, **fields)
    assert issubclass(error, SMEError)
