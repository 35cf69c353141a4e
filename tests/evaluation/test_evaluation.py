"""`evaluate`: exact at both ends of the scale, and the numbers of the definition between them."""

import inspect

import numpy as np
import pytest

import sme_registry
from sme_registry import evaluate, materialize
from sme_registry.errors import SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.evaluate import evaluation_observations
from sme_registry.spec import EvaluationProtocol, ProtocolFile
from tests.evaluation.kinds import (
    NAMES,
    PLAIN,
    PROTOCOL,
    TEAM,
    WIDTHS,
    half,
    linear,
    observations,
    optimal_of,
    report_of,
)


@pytest.fixture
def report():
    return report_of("plain")


def test_a_policy_is_asked_for_actions_in_the_observations_in_their_order():
    shown = []

    def record(observations):
        shown.append(observations)
        return half(3)(observations)

    protocol = EvaluationProtocol(states_per_region=10_000)  # more than a batch
    evaluate(record, PLAIN, protocol)
    assert np.array_equal(np.concatenate(shown), evaluation_observations(PLAIN, protocol))
    with pytest.raises(SpecError, match="team"):
        evaluation_observations("Team2-v1", protocol)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
@pytest.mark.parametrize("complexity", [1, 3, 10])
def test_optimal_policy_has_similarity_1_and_regret_0(monkeypatch, backend, complexity):
    if backend == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", backend)
    spec = PLAIN.derive(complexity=complexity)
    for region in evaluate(optimal_of(spec), spec, PROTOCOL).regions:
        assert region.similarity == pytest.approx(1.0, abs=1e-9)
        assert region.normalised_regret == pytest.approx(0.0, abs=1e-9)
        assert region.similarity_sd < 1e-9
        assert region.similarity_decay == pytest.approx(0.0, abs=1e-9)


SEPARATE = {name: half(width) for name, width in zip(NAMES, WIDTHS, strict=True)}


@pytest.mark.parametrize(
    ("policy", "spec"), [(half(3), PLAIN), (SEPARATE, TEAM), (half(3), TEAM)],
    ids=["plain", "separate", "shared"],
)  # fmt: skip
def test_constant_half_has_normalised_regret_of_exactly_1(policy, spec):
    result = evaluate(policy, spec, PROTOCOL)
    for scope in (result, *result.agents.values()):
        for region in scope.regions:
            assert region.normalised_regret == 1.0
            assert {channel.normalised_regret for channel in region.channels} == {1.0}


def test_numbers_are_those_of_the_definition(report):
    task = materialize(PLAIN)
    inside = None
    for index, region in enumerate(report.regions):
        o = observations(PROTOCOL, index, PLAIN)
        s, a = o[:, :4].astype(np.float64), np.clip(linear(o), 0.0, 1.0).astype(np.float64)
        optimal = task.optimal_action(s)
        similarity = task.similarity(s, a)
        inside = similarity.mean() if inside is None else inside
        missed = np.abs(a - optimal)
        floor = np.abs(0.5 - optimal)
        assert (region.epsilon_low, region.epsilon_high) == PROTOCOL.edges[index]
        assert region.states == PROTOCOL.states_per_region
        assert region.similarity == pytest.approx(similarity.mean(), abs=1e-12)
        assert region.similarity_sd == pytest.approx(similarity.std(ddof=1), abs=1e-12)
        assert region.mae == pytest.approx(missed.mean(), abs=1e-12)
        assert region.normalised_regret == pytest.approx(missed.mean() / floor.mean(), abs=1e-12)
        lost = inside - similarity.mean()
        assert region.similarity_decay == pytest.approx(lost / inside, abs=1e-12)
        assert region.similarity_loss == pytest.approx(100 * lost, abs=1e-9)
        assert region.clipped_share == np.mean((linear(o) < 0) | (linear(o) > 1))
        for channel, mae, half_mae in zip(
            region.channels, missed.mean(axis=0), floor.mean(axis=0), strict=True
        ):
            assert channel.mae == pytest.approx(mae, abs=1e-12)
            assert channel.normalised_regret == pytest.approx(mae / half_mae, abs=1e-12)


def test_references_stand_in_their_known_order_and_have_every_region(report):
    inside = {name: rows[0].normalised_regret for name, rows in report.references.items()}
    assert tuple(inside) == references.NAMES
    assert inside["optimal"] == 0.0
    assert 0.0 < inside["linear"] < inside["best_constant"] <= 1.0
    assert inside["constant"] == 1.0 < inside["random"]
    edges = [(region.epsilon_low, region.epsilon_high) for region in report.regions]
    for rows in report.references.values():
        assert [(row.epsilon_low, row.epsilon_high) for row in rows] == edges
        assert all(row.clipped_share == 0.0 for row in rows)


@pytest.mark.parametrize("protocol", ["quick-v1", "quick", "specs/protocols/quick-v1.json"])
def test_a_protocol_goes_by_its_name_or_its_path(protocol):
    quick = ProtocolFile.read("specs/protocols/quick-v1.json").protocol
    assert evaluate(half(3), PLAIN, protocol).protocol == quick


def test_the_default_protocol_is_the_papers():
    default = inspect.signature(evaluate).parameters["protocol"].default
    paper = sme_registry.evaluation.resolve_protocol(default)
    assert paper == EvaluationProtocol(states_per_region=50_000, epsilons=(0.2, 0.4, 0.6, 0.8, 1.0))
