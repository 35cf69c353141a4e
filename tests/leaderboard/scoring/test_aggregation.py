"""From runs to a method's scores: what an instance, a class and the method weigh."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leaderboard.documents.result import METRICS, Estimate, Result, Scores
from leaderboard.documents.submission import Submission
from leaderboard.scoring.ranking import (
    failed_run,
    is_oracle_like,
    never_listed,
    result_of,
)
from sme_registry import EvaluationProtocol
from sme_registry.statistics import iqm
from tests.leaderboard.conftest import document_of, plain_submission, suite_of
from tests.leaderboard.store.synthetic import scored_run

BOARD = document_of(suite_of(two=(2, {}), three=(3, {"complexity": 2})), draws=200)
CLASS_OF = {digest: name for digest, (name, _) in BOARD.instances.items()}
SPECS = list(CLASS_OF)
TWO, THREE = SPECS[:2], SPECS[2:]
ID = "sha256:" + "0" * 64
LEVELS = (0.0, *BOARD.protocol.epsilons)


def run(spec, regret):
    if regret is None:
        return failed_run(BOARD.protocol, CLASS_OF[spec], spec)
    if isinstance(regret, float):
        regret = [regret + 0.1 * level for level in LEVELS]
    return scored_run(BOARD.protocol, CLASS_OF[spec], spec, "sha256:" + "a" * 64, regret)


def scored(regrets, unlisted=None):
    """The result of runs of this WD regret, None if failed, and of unlisted ones of each class."""
    runs = [run(spec, regret) for spec, values in regrets.items() for regret in values]
    return result_of(BOARD, ID, runs, {}, unlisted=never_listed(BOARD, started(runs, unlisted)))


def started(runs, unlisted):
    listed = [
        {
            "spec": each.spec,
            "seed": number,
            "steps": 1,
            "artefact": each.artefact and {"sha256": f"sha256:{number:064x}", "size": 1},
        }
        for number, each in enumerate(runs)
    ]
    plain = plain_submission(BOARD, listed)
    plain["runs_started"] = Counter(plain["runs_started"]) + Counter(unlisted)
    return Submission.from_dict(plain)


def theta(result, metric="wd_regret"):
    return float(getattr(result.scores, metric).value)


EVEN = {**dict.fromkeys(TWO, [0.2] * 5), **dict.fromkeys(THREE, [0.2] * 4)}

# What a method scores


def test_a_class_is_the_mean_over_its_instances_and_the_method_the_mean_over_classes():
    values = [[0.1], [0.2, 0.3, 0.4, 0.9], [0.5] * 7, [0.6], [0.7, 0.0]]
    result = scored(dict(zip(SPECS, values, strict=True)))
    means = [float(iqm(each)) for each in values]
    classes = [np.mean(means[:2]), np.mean(means[2:])]
    assert [each.wd_regret for each in result.classes] == pytest.approx(classes)
    assert theta(result) == pytest.approx(np.mean(classes))
    for index, region in enumerate(result.scores.normalised_regret):
        assert region.value == pytest.approx(
            np.mean([each.normalised_regret[index] for each in result.classes])
        )


def test_each_instance_needs_its_share_of_the_runs():
    assert scored(EVEN).enough_runs
    for spec in SPECS:
        fewer = {**EVEN, spec: EVEN[spec][1:]}
        assert not scored(fewer).enough_runs
        more = {other: runs * (10 if other != spec else 1) for other, runs in fewer.items()}
        assert not scored(more).enough_runs
        assert scored({**fewer, spec: [*fewer[spec], None]}).enough_runs
    one_each = BOARD.model_copy(update={"runs_to_rank": 2})
    assert result_of(one_each, ID, [run(spec, 0.3) for spec in SPECS], {}).enough_runs
    assert (BOARD.runs_needed, one_each.runs_needed) == (22, 5)


def test_unlisted_runs_count_on_the_instances_with_the_fewest_runs():
    runs = [run(spec, 0.2) for spec in (TWO[0], TWO[1], TWO[1], *THREE)]
    unlisted = never_listed(BOARD, started(runs, {"two": 4, "three": 2}))
    assert [each.spec for each in unlisted] == [TWO[0], TWO[0], TWO[1], TWO[0], *THREE[:2]]
    assert all(each.artefact is None and each.wd_regret == 1.0 for each in unlisted)
    result = result_of(BOARD, ID, runs, {}, unlisted=unlisted)
    assert result.runs == tuple(runs)
    assert [(each.runs, each.submitted) for each in result.classes] == [(7, 3), (5, 3)]
    assert theta(result) == pytest.approx(
        np.mean([np.mean([1.0, iqm([0.2, 0.2, 1.0])]), np.mean([0.6, 0.6, 0.2])])
    )


# Giving up

REGRET = st.floats(0.0, 1.0)
RUNS = st.fixed_dictionaries({spec: st.lists(REGRET, min_size=1, max_size=9) for spec in SPECS})


def flat(regrets):
    return [run(spec, [each] * 6) for spec, values in regrets.items() for each in values]


@settings(max_examples=30)
@given(RUNS, st.sampled_from(SPECS), st.integers(1, 20), st.sampled_from(tuple(METRICS)[:3]))
def test_giving_up_an_instance_costs_what_was_learned_there(regrets, spec, failures, metric):
    board = BOARD.model_copy(update={"draws": 100})
    rest = flat({other: values for other, values in regrets.items() if other != spec})
    failed = [failed_run(board.protocol, CLASS_OF[spec], spec)] * failures
    honest, gave_up = (
        result_of(board, ID, [*rest, *own], {}) for own in (flat({spec: regrets[spec]}), failed)
    )
    learned = 1.0 - (float(iqm(regrets[spec])) if metric != "ood_decay" else 0.0)
    share = 1 / 4 if spec in TWO else 1 / 6
    lost = theta(gave_up, metric) - theta(honest, metric)
    assert lost == pytest.approx(share * learned, abs=1e-9)


@settings(max_examples=30)
@given(st.integers(1, 6), st.data())
def test_leaving_runs_out_never_improves_a_method_with_as_many_runs_on_each_instance(count, data):
    board = BOARD.model_copy(update={"draws": 100})
    values = {spec: data.draw(st.lists(REGRET, min_size=count, max_size=count)) for spec in SPECS}
    left = {spec: data.draw(st.integers(0, count - 1)) for spec in SPECS}
    kept = flat({spec: sorted(each)[: count - left[spec]] for spec, each in values.items()})
    missing = {
        "two": sum(left[spec] for spec in TWO),
        "three": sum(left[spec] for spec in THREE),
    }
    honest = result_of(board, ID, flat(values), {})
    chosen = result_of(board, ID, kept, {}, unlisted=never_listed(board, started(kept, missing)))
    for metric in METRICS:
        assert theta(chosen, metric) >= theta(honest, metric) - 1e-9, metric


# Intervals


def ends(result, metric="wd_regret"):
    return getattr(result.scores, metric).interval


def drawn(seed, counts):
    rng = np.random.default_rng(seed)
    return [
        run(spec, rng.random(6).tolist())
        for spec, count in zip(SPECS, counts, strict=True)
        for _ in range(count)
    ]


def test_the_protocol_seeds_an_interval_and_neither_id_nor_order_of_runs_changes_it():
    runs = drawn(0, [5, 5, 4, 4, 4])
    result = result_of(BOARD, ID, runs, {})
    for number in range(3):
        shuffled = np.random.default_rng(number).permutation(len(runs))
        other = result_of(BOARD, f"sha256:{number:064x}", [runs[i] for i in shuffled], {})
        for metric in METRICS:
            assert ends(other, metric) == pytest.approx(ends(result, metric), abs=1e-12)
    protocol = EvaluationProtocol(states_per_region=61)
    other = BOARD.model_copy(update={"protocol": protocol})
    assert ends(result) != ends(result_of(other, ID, runs, {}))


def test_single_runs_of_several_instances_have_a_wide_interval_and_lone_ones_none():
    single = result_of(BOARD, ID, drawn(3, [1] * 5), {})
    low, high = ends(single)
    assert low < theta(single) < high
    lone = BOARD.model_copy(update={"suite": suite_of(two=(1, {}))})
    result = result_of(lone, ID, [run(TWO[0], 0.5)], {})
    assert ends(result) is None
    assert result.scores.wd_regret.ends == (theta(result),) * 2
    assert Result.from_dict(result.to_dict()) == result


def test_no_interval_of_a_regret_reaches_below_zero():
    assert ends(scored({spec: [0.0, 0.0, 0.9, 0.0] for spec in SPECS}))[0] == 0.0
    assert ends(result_of(BOARD, ID, drawn(4, [4] * 5), {}), "ood_decay")[0] < 0.0


# Marks


@pytest.mark.parametrize(
    ("wd", "ood", "expected"),
    [
        (0.0, 0.01, True),
        (0.0, 0.011, True),
        (0.011, 0.022, False),
        (0.05, 0.06 - 1e-12, True),
        (0.051, 0.051, False),
    ],
)
@pytest.mark.parametrize("rules", [2, 3])
def test_oracle_like_is_little_regret_in_a_region_or_as_little_outside_as_inside(
    wd, ood, expected, rules
):
    values = {
        "wd_regret": wd,
        "ood_regret": ood,
        "ood_decay": round(ood - wd, 9),
        "regret_slope": 0.0,
        "similarity_loss": 0.0,
    }
    estimates = {name: Estimate(value=x, low=x, high=x) for name, x in values.items()}
    assert tuple(values) == tuple(METRICS)
    scores = Scores(**estimates, normalised_regret=(estimates["wd_regret"],) * 2)
    assert is_oracle_like(scores, rules) is expected


def test_one_oracle_like_run_marks_a_method():
    level = Estimate(value=0.4, low=0.4, high=0.4)
    scores = Scores(**dict.fromkeys(METRICS, level), normalised_regret=(level, level))
    run = failed_run(BOARD.protocol, "two", None)
    near = run.model_copy(update={"wd_regret": 0.005})
    assert not is_oracle_like(scores, 3, [run])
    assert is_oracle_like(scores, 3, [run, near])
