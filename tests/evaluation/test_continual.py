"""Streams: retention without a rollout, the papers' metrics, dynamic regret, reports, seeds."""

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import trim_mean

import sme_registry
from sme_registry import evaluate, materialize
from sme_registry.errors import (
    DigestMismatchError,
    OptionError,
    PolicyError,
    SMEError,
    SpecError,
    UnknownNameError,
)
from sme_registry.evaluation import (
    StreamReport,
    across_seeds,
    dynamic_regret,
    evaluate_stream,
    expected_regret,
    reference_regret,
    retention,
)
from sme_registry.evaluation.dynamic_regret import RegretBlocks
from sme_registry.evaluation.report import as_text
from sme_registry.evaluation.retention import final_specs
from sme_registry.spec import StreamSpec
from tests.evaluation.streams import SPEC, TWICE, half, network, stream_of

PROTOCOL = {"states_per_region": 300, "epsilons": [0.5, 1.0]}
THREE = stream_of(SPEC, SPEC.derive(seed=1, k=5, r_min=0.5), SPEC.derive(rotation=1.0))


def matrix(report, region="WD"):
    return np.array(report.region(region).agent.normalised_regret)


@functools.cache
def report(seed=0):
    policies = [network(3 * seed + v) for v in range(3)]
    fresh = [network(100 + seed), "linear", half]
    return evaluate_stream(policies, THREE, PROTOCOL, initial=half, fresh=fresh, name="agent")


# Retention


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_the_matrix_has_the_normalised_regret_of_an_evaluation_on_each_phases_task():
    for j, phase in enumerate(THREE.phases):
        for v in range(3):
            for region in evaluate(network(v), phase.spec, PROTOCOL).regions:
                found = matrix(report(), region.name)[v, j]
                assert found == pytest.approx(region.normalised_regret, rel=1e-12)
        shells = [matrix(report(), name)[:, j] for name in ("OOD 1", "OOD 2")]
        np.testing.assert_allclose(matrix(report(), "OOD")[:, j], np.mean(shells, axis=0))
    with pytest.raises(UnknownNameError, match=r"region='OD 1': .* Did you mean 'OOD 1'"):
        report().region("OD 1")


def test_initial_and_fresh_agents_are_measured_on_their_phases():
    agent = report().region().agent
    assert agent.initial_normalised_regret == pytest.approx((1.0, 1.0, 1.0))
    alone = [network(100), "linear", half]
    for j, policy in enumerate(alone):
        # The name of a reference policy stands for that of the first phase.
        policy = evaluate_stream([policy] * 3, THREE, PROTOCOL)
        assert agent.fresh_normalised_regret[j] == matrix(policy)[0, j]
    ratio = np.diag(matrix(report())) / agent.fresh_normalised_regret
    assert agent.plasticity_ratio == pytest.approx(tuple(ratio))
    assert agent.final("plasticity_ratio") == pytest.approx(ratio[1:].mean())


def test_a_drifting_phase_is_evaluated_on_its_last_piece():
    last = SPEC.derive(rotation=1.5)
    stream = stream_of(SPEC, steps=40, drift={"rotation": 2.0, "increments": 4})
    assert final_specs(stream) == (last,)
    drifted = evaluate_stream([network(0)], stream, PROTOCOL)
    alone = evaluate_stream([network(0)], stream_of(last), PROTOCOL)
    assert (matrix(drifted) == matrix(alone)).all()
    assert drifted.visits[0].spec_digest == last.digest


def test_a_policy_that_observes_the_phase_is_given_that_of_the_task():
    specs = [SPEC, SPEC.derive(seed=1)]
    tasks = [materialize(spec) for spec in specs]

    def oracle(observations):
        assert observations.shape[1] == SPEC.state_dim + 2 + 2
        (phase,) = np.unique(observations[:, -2:].argmax(axis=1))
        assert (observations[:, -2:].sum(axis=1) == 1.0).all()
        return tasks[phase].optimal_action(observations[:, : SPEC.state_dim])

    observed = evaluate_stream([oracle] * 2, stream_of(*specs, observes_phase=True), PROTOCOL)
    assert np.abs(matrix(observed)).max() < 1e-12
    with pytest.raises(PolicyError, match=r"policies\[0\].*shape"):
        evaluate_stream([network(0)] * 2, stream_of(*specs, observes_phase=True), PROTOCOL)


def test_each_policy_acts_once_in_each_state():
    seen = []

    def counted(observations):
        seen.append(len(observations))
        observations[:] = 0.0  # must not change what others observe
        return half(observations)

    evaluate_stream([counted, network(0), counted], THREE, PROTOCOL)
    assert sum(seen) == 3 * PROTOCOL["states_per_region"]
    beside = evaluate_stream([counted, network(0), counted], THREE, PROTOCOL)
    assert (matrix(beside)[1] == matrix(report())[0]).all()


def test_reference_agents_are_exact():
    references = report().regions[0].references
    M = {name: np.array(each.normalised_regret) for name, each in references.items()}
    assert M.keys() == {"frozen_optimum", "fresh_optimum", "constant"}
    assert (M["constant"] == 1.0).all()
    assert (np.diag(M["fresh_optimum"]) == 0.0).all()
    assert (M["frozen_optimum"] == M["fresh_optimum"][0]).all()
    for j, phase in enumerate(THREE.phases):
        task = materialize(SPEC)
        single = evaluate(lambda o: task.optimal_action(o[:, :4]), phase.spec, PROTOCOL)  # noqa: B023
        assert M["frozen_optimum"][0, j] == pytest.approx(single.wd_regret, abs=1e-12)


def test_lives_are_named_after_their_policies_and_may_be_frozen_or_start_anew():
    lives = [["constant"] * 3, ["constant", "constant", "random"]]
    reports = [evaluate_stream(life, THREE, PROTOCOL) for life in lives]
    assert [each.policy for each in reports] == ["constant", "3 policies"]


# Metrics


def test_metrics_of_one_cycle_are_those_of_the_papers():
    T = 5
    a = np.random.default_rng(0).random((T, T))  # after task i on task j
    b = np.random.default_rng(1).random(T)  # of the initial policy
    R, initial = a[..., None], b[:, None]
    # Lopez-Paz & Ranzato 2017, equations 2 to 4
    ACC = sum(a[T - 1, i] for i in range(T)) / T
    BWT = sum(a[T - 1, i] - a[i, i] for i in range(T - 1)) / (T - 1)
    FWT = sum(a[i - 1, i] - b[i] for i in range(1, T)) / (T - 1)
    assert retention.average_performance(R)[-1, 0] == pytest.approx(ACC)
    assert retention.backward_transfer(R)[-1, 0] == pytest.approx(BWT)
    assert retention.forward_transfer(R, initial)[0] == pytest.approx(FWT)
    # Chaudhry et al. 2018, equations 2 and 3, for each k
    for k in range(1, T):
        f = [max(a[i, j] for i in range(k)) - a[k, j] for j in range(k)]
        assert retention.forgetting(R)[k, 0] == pytest.approx(sum(f) / k)
        A = sum(a[k, j] for j in range(k + 1)) / (k + 1)
        assert retention.average_performance(R)[k, 0] == pytest.approx(A)
    assert np.isnan(retention.relearning(R)[0])


def test_metrics_of_several_cycles_are_by_visits():
    R = np.array([[0.8, 0.1], [0.2, 0.7], [0.9, 0.3], [0.4, 0.6]])[..., None]
    assert retention.backward_transfer(R)[:, 0] == pytest.approx(
        [np.nan, 0.2 - 0.8, 0.3 - 0.7, 0.4 - 0.9], nan_ok=True
    )
    assert retention.forgetting(R)[:, 0] == pytest.approx(
        [np.nan, 0.8 - 0.2, 0.7 - 0.3, 0.9 - 0.4], nan_ok=True
    )
    assert retention.average_performance(R)[:, 0] == pytest.approx([0.8, 0.45, 0.6, 0.5])
    assert retention.relearning(R)[0] == pytest.approx((0.1 - 0.1) / 2)
    assert retention.forward_transfer(R, np.array([[0.5], [0.3]]))[0] == pytest.approx(0.1 - 0.3)


def test_plasticity_compares_the_visited_phase_with_a_fresh_agent():
    M = np.array([[0.2, 1.0], [1.0, 0.6], [0.4, 1.0], [1.0, 0.9]])[..., None]
    ratio, difference = retention.plasticity(M, np.array([[0.2], [0.0]]))
    assert ratio[:, 0] == pytest.approx([1.0, np.nan, 2.0, np.nan], nan_ok=True)
    assert difference[:, 0] == pytest.approx([0.0, 0.6, 0.2, 0.9])


def test_what_cannot_be_compared_is_none():
    alone = evaluate_stream([half], stream_of(SPEC), PROTOCOL)
    agent = alone.regions[0].agent
    assert agent.backward_transfer == agent.forgetting == agent.plasticity_ratio == (None,)
    assert agent.forward_transfer is agent.relearning is agent.final("forgetting") is None
    assert "forgetting" not in str(alone)
    only = evaluate_stream([half], stream_of(SPEC), PROTOCOL, fresh=["linear"]).regions[0].agent
    assert only.plasticity_ratio[0] > 1.0
    assert only.final("plasticity_ratio") is only.final("plasticity_difference") is None


# Dynamic regret


@st.composite
def lives(draw):
    """A stream, and the lengths of a life's episodes and the regret of each of its steps."""
    steps = draw(st.lists(st.integers(3, 12), min_size=1, max_size=3))
    phases = [{"spec": SPEC.derive(seed=i), "steps": n} for i, n in enumerate(steps)]
    switch = draw(st.sampled_from(["episode", "step"]))
    stream = StreamSpec(phases=phases, cycles=draw(st.integers(1, 3)), switch=switch)
    lengths = draw(st.lists(st.integers(1, 5), min_size=1, max_size=30))
    regrets = np.random.default_rng(draw(st.integers(0, 9))).random(sum(lengths))
    return stream, np.array(lengths), regrets


@given(lives())
def test_dynamic_regret_by_visit_is_that_of_the_task_in_force(life):
    stream, lengths, regrets = life
    P, V = len(stream.phases), len(stream.phases) * stream.cycles
    ends = np.cumsum([phase.steps for phase in stream.phases] * stream.cycles)
    visits = []
    for begin, length in zip(np.cumsum(lengths) - lengths, lengths, strict=True):
        for i in range(length):
            at = begin if stream.switch == "episode" else begin + i
            visits.append(min(int((ends <= at).sum()), V - 1))
    expected = np.bincount(visits, regrets)
    step = np.arange(1, len(regrets) + 1)
    of_steps = dynamic_regret(stream, step, regrets, phase=np.array(visits) % P)
    found = [visit.dynamic_regret for visit in of_steps.visits]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert [visit.steps for visit in of_steps.visits] == np.bincount(visits).tolist()
    assert of_steps.steps == len(regrets)
    assert of_steps.dynamic_regret == pytest.approx(regrets.sum())
    np.testing.assert_allclose(of_steps.cumulative_regret, np.cumsum(regrets))

    means = [part.mean() for part in np.split(regrets, np.cumsum(lengths)[:-1])]
    of_episodes = dynamic_regret(stream, np.cumsum(lengths), means, lengths)
    by_visit = [visit.dynamic_regret for visit in of_episodes.visits]
    assert sum(by_visit) == pytest.approx(regrets.sum())
    if stream.switch == "episode":
        np.testing.assert_allclose(by_visit, expected, atol=1e-9)


def played(stream, more):
    """A life of random actions, by step: `lifetime`, `regret` and `phase`."""
    env = sme_registry.make(stream)
    env.action_space.seed(0)
    env.reset(seed=0)
    rows = []
    for _ in range(stream.steps + more):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        rows.append((info["lifetime"], info["regret"], info["phase"]))
        if terminated or truncated:
            env.reset()
    return map(np.array, zip(*rows, strict=True))


def test_an_episode_in_two_visits_is_divided_in_proportion():
    stream = stream_of(SPEC, SPEC.derive(seed=1), steps=10, switch="step")
    divided = dynamic_regret(stream, [8, 12], [0.5, 1.0], [8, 4])
    assert [visit.dynamic_regret for visit in divided.visits] == [4.0 + 2.0, 2.0]
    assert [visit.steps for visit in divided.visits] == [10, 2]
    stream = stream_of(SPEC, SPEC.derive(seed=1), steps=10)
    whole = dynamic_regret(stream, [8, 12], [0.5, 1], [8, 4])
    assert [visit.dynamic_regret for visit in whole.visits] == [8.0]


def test_learning_transfer_is_the_forward_transfer_of_continual_world():
    # Wołczyk et al. 2021, section 4: (AUC − AUC_b) / (1 − AUC_b), AUC the mean of performance.
    performance, alone = np.array([0.4, 0.5, 0.9, 0.1]), np.array([0.4, 0.8])
    expected = [0.0, (0.5 - 0.8) / 0.2, (0.9 - 0.4) / 0.6, (0.1 - 0.8) / 0.2]
    log = dynamic_regret(TWICE, [50, 100, 150, 200], 1.0 - performance, 50)
    assert log.learning_transfer is log.visits[0].learning_transfer is None
    log = log.with_fresh(TWICE, 1.0 - alone)
    assert [visit.learning_transfer for visit in log.visits] == pytest.approx(expected)
    assert log.learning_transfer == pytest.approx(np.mean(expected[1:]))
    assert log.fresh_online_regret == pytest.approx((0.6, 0.2))


def test_learning_transfer_needs_a_visit_that_is_over_and_regret_of_a_fresh_agent():
    # Visit 1 is not over, and visit 0 lacks the end of an episode only.
    log = dynamic_regret(TWICE, [45, 60], [0.5, 0.5], [45, 10]).with_fresh(TWICE, [0.5, 0.5])
    assert [visit.learning_transfer for visit in log.visits] == [0.0, None]
    assert log.learning_transfer is None
    optimal = dynamic_regret(TWICE, [50], [0.5], 50).with_fresh(TWICE, [0.0, 0.5])
    assert optimal.learning_transfer is optimal.visits[0].learning_transfer is None
    # The last visit begins 6 steps late and ends in an unfinished episode of 6 steps.
    late = dynamic_regret(TWICE, [56, 106, 156, 194], [0.5] * 4, [56, 50, 50, 38])
    late = late.with_fresh(TWICE, [1.0, 1.0])
    assert [visit.learning_transfer for visit in late.visits] == [0.5] * 4
    # A visit of less than an episode of 10 steps.
    short = stream_of(SPEC, SPEC.derive(seed=1), steps=8)
    for steps, expected in ((3, None), (5, 0.5)):
        log = dynamic_regret(short, [steps], [0.5], steps).with_fresh(short, [1.0, 1.0])
        assert log.visits[0].learning_transfer == expected


@pytest.mark.parametrize(
    ("online", "message"),
    [
        ([0.5], "fresh online_regret=.*must be one number or 2, one for each phase"),
        ([0.5, 1.5], r"fresh online_regret=\[0.5, 1.5\]: must be .* in \[0, 1\]"),
        ([0.5, float("nan")], r"fresh online_regret=\[0.5, nan\]: must be .* in \[0, 1\]"),
    ],
)
def test_invalid_regret_of_fresh_agents_is_refused(online, message):
    with pytest.raises(OptionError, match=message):
        dynamic_regret(TWICE, [50], [0.5], 50).with_fresh(TWICE, online)


@pytest.mark.parametrize(
    "other",
    [
        stream_of(SPEC, cycles=4),
        stream_of(SPEC, SPEC.derive(seed=1)),
        stream_of(SPEC, SPEC.derive(seed=1), cycles=2, steps=40),
        stream_of(SPEC, SPEC.derive(seed=1), cycles=2, steps=90),
    ],
)
@pytest.mark.parametrize("switch", ["episode", "step"])
def test_fresh_agents_of_another_stream_are_refused(other, switch):
    own = stream_of(SPEC, SPEC.derive(seed=1), cycles=2, switch=switch)
    log = dynamic_regret(own, [50, 100, 150], [0.5, 0.5, 0.5], 50)
    assert log.with_fresh(own, [0.5, 0.5]).learning_transfer == 0.0
    other = StreamSpec.from_dict({**other.to_dict(), "switch": switch})
    with pytest.raises(OptionError, match=r"stream: is another one than that of this life, .* 150"):
        log.with_fresh(other, [0.5] * len(other.phases))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (([], []), "step: has no rows"),
        (([1, 2], [0.5]), "regret=.*must be one number or 2, one for each row"),
        (([1, 2], [0.5, 1.5]), r"regret=.* in \[0, 1\]"),
        (([2, 1], [0.5, 0.5]), "must not overlap"),
        (([4, 6], [0.5, 0.5], 3), "must not overlap"),
        (([1], [0.5], 0), "length=0: must be one integer or 1"),
        (([1], [0.5], 1, [3]), r"phase=\[3\]: must be .* in \[0, 2\]"),
        (([1], [0.5], 1, [1]), "phase: must be .* has begun"),
    ],
)
def test_an_invalid_log_is_refused(columns, message):
    with pytest.raises(OptionError, match=message):
        dynamic_regret(THREE, *columns)


@pytest.mark.parametrize("fields", [{}, {"switch": "step"}, {"cycles": 1}])
def test_blocks_of_a_life_give_the_regret_of_its_single_steps(fields):
    """With early termination, phases shorter than an episode, and steps after the last visit."""
    specs = [SPEC, SPEC.derive(seed=1, D=0.3), SPEC.derive(k=5)]
    phases = [
        {"spec": spec, "steps": steps} for spec, steps in zip(specs, (700, 5, 605), strict=True)
    ]
    stream = StreamSpec(phases=phases, **{"cycles": 2, **fields})
    lifetime, regret, phase = played(stream, 30)
    blocks = RegretBlocks(stream, 2)
    for begin in range(0, len(regret), 97):
        part = slice(begin, begin + 97)
        both = np.stack([np.zeros_like(regret[part]), regret[part]], axis=1)
        blocks.add(lifetime[part][-1], both, phase[part])
    found = blocks.dynamic_regret(1)
    expected = dynamic_regret(stream, lifetime, regret, phase=phase)
    assert [visit.steps for visit in found.visits] == [visit.steps for visit in expected.visits]
    sums = [[visit.dynamic_regret for visit in each.visits] for each in (found, expected)]
    np.testing.assert_allclose(*sums, atol=1e-9)
    assert found.dynamic_regret == pytest.approx(expected.dynamic_regret)
    assert blocks.dynamic_regret(0).dynamic_regret == 0.0
    assert len(blocks.steps) <= 1000 < len(regret)


# Reports


def test_a_report_is_the_same_after_it_was_written_and_read(tmp_path):
    regret = dynamic_regret(THREE, [10, 20], [0.5, 0.25], 10)
    written = report().with_dynamic_regret(regret)
    path = written.write(tmp_path / "stream.json")
    assert StreamReport.read(path) == written
    assert "dynamic regret 7.5 over 20 steps" in str(written)
    path.write_text(path.read_text().replace('"switch": "episode"', '"switch": "step"'))
    with pytest.raises(DigestMismatchError, match="stream_digest"):
        StreamReport.read(path)


def test_the_tables_have_the_reports_numbers():
    text = str(report())
    agent = report().regions[0].agent
    for value in (*np.ravel(agent.normalised_regret), agent.forward_transfer, agent.forgetting[-1]):
        assert f"{value:.3f}" in text
    ood = as_text(report().matrix("OOD"))
    assert f"{report().ood.agent.normalised_regret[1][2]:.3f}" in ood


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([half], THREE), OptionError, "policies=1 of them: must be 3 policies"),
        ((half, THREE), OptionError, "policies=.*must be 3 policies"),
        ((["constant", "constant"], THREE), OptionError, "policies=2 of them"),
        (([half, half, lambda o: o], THREE), PolicyError, r"policies\[2\]: policy 'policy'"),
        (([half, half, "linaer"], THREE), UnknownNameError, r"policies\[2\]: .*'linear'"),
        (([half] * 5, "Swich5"), UnknownNameError, "Switch5"),
    ],
)
def test_bad_input_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        evaluate_stream(*arguments, PROTOCOL)
    assert issubclass(error, SMEError)
    message = "fresh=1 of them: must be 2 policies, one for each phase"
    with pytest.raises(OptionError, match=message):
        evaluate_stream([half] * 4, TWICE, PROTOCOL, fresh=[half])


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_fresh_agents_do_not_see_the_phase_that_a_life_observes():
    observed = stream_of(SPEC, SPEC.derive(seed=1), observes_phase=True)
    life, fresh = [network(v, SPEC.state_dim + 4) for v in range(2)], [network(3), network(4)]
    report = evaluate_stream(life, observed, PROTOCOL, fresh=fresh)
    expected = [
        evaluate(alone, phase.spec, PROTOCOL).regions[0].normalised_regret
        for alone, phase in zip(fresh, observed.phases, strict=True)
    ]
    assert report.region().agent.fresh_normalised_regret == pytest.approx(expected)


def test_a_life_of_more_visits_than_are_evaluated_is_refused():
    long = stream_of(SPEC, SPEC.derive(seed=1), cycles=501)
    message = "cycles × phases=.* must be at most 1,000"
    with pytest.raises(SpecError, match=message):
        evaluate_stream([half] * 1002, long, PROTOCOL)
    with pytest.raises(SpecError, match=message):
        expected_regret([half] * 1002, long, episodes=1)
    with pytest.raises(SpecError, match=message):
        reference_regret(stream_of(SPEC, cycles=10**6), episodes=1)


def test_fresh_agents_that_were_evaluated_by_themselves_give_the_same_plasticity():
    drift, second = {"rotation": 2.0, "increments": 2}, SPEC.derive(seed=1)
    stream = stream_of(SPEC, second, drift=drift, cycles=2)
    life, alone = [network(v) for v in range(4)], [network(100), network(101)]
    together = evaluate_stream(life, stream, PROTOCOL, fresh=alone)
    of_drift = evaluate_stream(alone[1:], stream_of(second, drift=drift), PROTOCOL)
    fresh = [evaluate(alone[0], SPEC, PROTOCOL), of_drift]
    without = evaluate_stream(life, stream, PROTOCOL)
    later = without.with_fresh(fresh)
    assert without.region().agent.plasticity_ratio == (None,) * 4
    for region in ("WD", "OOD 2", "OOD"):
        ours, theirs = later.region(region), together.region(region)
        for metric in ("fresh_normalised_regret", "plasticity_ratio", "plasticity_difference"):
            assert getattr(ours.agent, metric) == pytest.approx(getattr(theirs.agent, metric))
        assert ours.agent.forgetting == theirs.agent.forgetting
        assert ours.references == theirs.references
    log = dynamic_regret(stream, [50, 100], [0.5, 0.5], 50)
    logged = without.with_dynamic_regret(log).with_fresh(fresh, [1.0, 0.25])
    assert logged.dynamic_regret.learning_transfer == pytest.approx(-1.0)
    assert logged.regions == later.regions
    other = evaluate(alone[0], SPEC, PROTOCOL | {"states_per_region": 20})
    two = "must be 2 reports, one for each phase"
    for wrong, message in (
        ([fresh, [1.0, 0.25]], "online_regret: this report has no dynamic regret"),
        ([fresh[:1]], f"fresh=1 reports: {two}"),
        *[([not_two], f"fresh=.*: {two}") for not_two in (None, "ab", fresh[0], [None, None])],
        ([[of_drift, of_drift]], r"fresh\[0\]: is about .* the task of phase 0"),
        ([[other, of_drift]], r"fresh\[0\]: .* and the protocol"),
    ):
        with pytest.raises(OptionError, match=message):
            without.with_fresh(*wrong)


# Seeds


def test_the_seed_is_the_unit_of_intervals():
    reports = [report(seed) for seed in range(5)]
    estimates = across_seeds(reports)
    runs = np.array([matrix(each).ravel() for each in reports])
    np.testing.assert_allclose(estimates["normalised_regret"].value, trim_mean(runs, 0.25))
    forgetting = estimates["forgetting"]
    assert np.isnan(forgetting.value[0])
    assert (forgetting.low[1:] < forgetting.value[1:]).all()
    assert "dynamic_regret" not in estimates
    alone = across_seeds(reports[:1], "OOD")
    assert np.isnan(alone["average_performance"].low).all()

    logs = [
        each.with_dynamic_regret(dynamic_regret(THREE, [50, 100], [0.1 * i, 0.5], 50))
        for i, each in enumerate(reports)
    ]
    estimates = across_seeds(logs)
    assert estimates["dynamic_regret"].value == pytest.approx(5 * 2 + 25)
    assert estimates["visit_dynamic_regret"].value == pytest.approx([10, 25])
    assert "learning_transfer" not in estimates

    logs = [
        each.with_dynamic_regret(each.dynamic_regret.with_fresh(THREE, [0.5, 0.25, 1.0]))
        for each in logs
    ]
    estimates = across_seeds(logs)
    assert estimates["visit_learning_transfer"].value == pytest.approx([0.6, -1.0])
    assert estimates["learning_transfer"].value == pytest.approx(-1.0)


def test_only_runs_of_one_stream_and_its_draws_are_combined():
    drawn = evaluate_stream([half] * 3, THREE.draw(1), PROTOCOL)
    forgetting = report().region().agent.forgetting[-1]
    both = across_seeds([report(), drawn])["forgetting"].value[-1]
    assert both == pytest.approx(forgetting / 2)
    other = evaluate_stream([half] * 4, TWICE, PROTOCOL)
    with pytest.raises(OptionError, match="2 different values of stream_digest"):
        across_seeds([report(), other])
    with pytest.raises(OptionError, match="one or more"):
        across_seeds([])
