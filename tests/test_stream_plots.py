"""Figures of streams: complete files, the reports' numbers, readable."""

import functools

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.errors import SMEError, UnknownNameError
from sme_registry.evaluation import (
    dynamic_regret,
    evaluate_stream,
    expected_regret,
    reference_regret,
)
from sme_registry.spec import StreamSpec

pytest.importorskip("matplotlib")

from sme_registry import plots
from sme_registry.statistics import iqm
from tests.geometry import assert_readable

SPEC = SMESpec(state_dim=3, action_dim=2, hidden_width=8)
PROTOCOL = {"states_per_region": 20, "epsilons": [0.5, 1.0]}
FIGURES = ("retention_map", "performance_curve", "dynamic_regret_curve", "plasticity_curve")


def stream_of(phases, cycles):
    steps = {"steps": 100}
    specs = [SPEC.derive(seed=seed) for seed in range(phases)]
    return StreamSpec(phases=[{"spec": spec, **steps} for spec in specs], cycles=cycles)


@functools.cache
def report(seed, phases=3, cycles=2):
    stream = stream_of(phases, cycles)
    random = np.random.default_rng(seed)

    def agent(weight):
        return lambda observations: 0.5 + (observations[:, :2] - 0.5) * weight

    V = len(stream.phases) * cycles
    made = evaluate_stream(
        [agent(weight) for weight in random.normal(size=V)],
        stream,
        PROTOCOL,
        initial="constant",
        fresh=[agent(weight) for weight in random.normal(size=phases)],
        name=r"a $\frac$ name",
    )
    step = np.arange(10, stream.steps + 1, 10)
    return made.with_dynamic_regret(dynamic_regret(stream, step, random.random(len(step)), 10))


def plain():
    """A report without fresh agents and without a log."""
    return evaluate_stream(["constant"] * 2, stream_of(2, 1), PROTOCOL)


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_is_written_and_readable(tmp_path, name):
    draw = getattr(plots, name)
    one = draw(report(0), tmp_path / f"{name}.png")
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.png"]
    three = draw([report(0), report(1), report(2)])
    for figure in (one, three, draw(report(0, phases=14, cycles=2))):
        assert_readable(figure)
    assert r"a \$\frac\$ name on SME/sha256-" in one.get_suptitle()
    assert "3 seeds" in three.get_suptitle()


def test_a_retention_map_shows_the_matrix_and_outlines_the_visited_phases():
    seeds = [report(seed) for seed in range(4)]
    axes = plots.retention_map(seeds, region="OOD 2").axes[0]
    M = iqm([each.region("OOD 2").agent.normalised_regret for each in seeds])
    np.testing.assert_allclose(axes.images[0].get_array()[1:], M)
    np.testing.assert_allclose(axes.images[0].get_array()[0], 1.0)  # the initial policy is ½
    centres = [(line.get_ydata()[:4].mean(), line.get_xdata()[:4].mean()) for line in axes.lines]
    outlined = {(round(row), round(column)) for row, column in centres}
    assert outlined == {(v + 1, v % 3) for v in range(6)}
    assert f"{M[0, 0]:.2f}" in [text.get_text() for text in axes.texts]
    with pytest.raises(UnknownNameError, match="region='OOD 9'"):
        plots.retention_map(seeds, region="OOD 9")


def test_a_performance_curve_has_a_line_for_each_phase_and_marks_its_visits():
    axes = plots.performance_curve(report(0)).axes[0]
    R = 1.0 - np.array(report(0).region().agent.normalised_regret)
    lines = {line.get_label(): line for line in axes.lines}
    own = [line for line in axes.lines if line.get_linestyle() == "None"]
    for j in range(3):
        drawn = lines[f"phase {j}"]
        np.testing.assert_allclose(drawn.get_ydata(), [0.0, *R[:, j]], atol=1e-12)
        assert own[j].get_xdata().tolist() == [j, 3 + j]
        np.testing.assert_allclose(own[j].get_ydata(), R[[j, 3 + j], j])


def test_a_dynamic_regret_curve_ends_at_the_sum_and_has_bands_for_visits():
    runs = {"one": report(0), "two": [report(1), report(2)]}
    figure = plots.dynamic_regret_curve(runs)
    axes = figure.axes[0]
    line, median = axes.lines[:2]
    assert line.get_ydata()[-1] == pytest.approx(report(0).dynamic_regret.dynamic_regret)
    sums = [report(seed).dynamic_regret.dynamic_regret for seed in (1, 2)]
    assert median.get_ydata()[-1] == pytest.approx(np.mean(sums))
    shaded = sorted(patch.get_x() for patch in axes.patches)
    assert shaded == [0, 200, 400]  # of every other of six visits
    assert [text.get_text() for text in axes.texts[:-1]] == list("012012")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:2] == ["one", "two (n = 2)"]


def test_a_dynamic_regret_curve_shows_reference_agents_in_grey():
    stream, log = stream_of(3, 2), report(0).dynamic_regret
    known = reference_regret(stream, frozen="constant", training=log, episodes=20)
    known["fresh_agents"] = expected_regret([0.25] * 6, stream)
    lives = [report(seed).with_reference_regret(known) for seed in (0, 1)]
    of_one, of_two, without = (
        {
            line.get_label(): line.get_ydata()[-1]
            for line in plots.dynamic_regret_curve(runs).axes[0].lines
        }
        for runs in (lives, {"one": lives[0], "two": lives[1]}, [lives[0], report(1)])
    )
    assert of_one["fresh agent in each phase"] == pytest.approx(0.25 * stream.steps)
    assert of_one["constant ½"] == pytest.approx(known["constant"].dynamic_regret)
    assert of_one.keys() >= {"optimum of phase 0", "frozen after visit 0"}
    assert of_two.keys() == {"one", "two", "constant ½", "optimum of phase 0"}
    assert len(without) == 1  # only one of the seeds has references


def test_a_plasticity_curve_shows_the_ratio_of_each_visit():
    line = plots.plasticity_curve(report(0)).axes[0].lines[0]
    assert line.get_ydata() == pytest.approx(report(0).region().agent.plasticity_ratio)


def test_reports_are_read_from_files_and_folders(tmp_path):
    report(0).write(tmp_path / "stream.json")
    figure = plots.retention_map([tmp_path, tmp_path / "stream.json"])
    assert "2 seeds" in figure.get_suptitle()


@pytest.mark.parametrize(
    ("draw", "runs", "message"),
    [
        (plots.retention_map, [], "one or more stream reports"),
        (plots.retention_map, 3, "runs=3: must be one or more StreamReports"),
        (plots.performance_curve, ["missing.json"], "missing.json"),
        (plots.plasticity_curve, lambda: [report(0), report(0, 2)], "different values of stream"),
        (plots.plasticity_curve, plain, "has no fresh agents"),
        (plots.dynamic_regret_curve, plain, "has no dynamic regret"),
    ],
)
def test_bad_input_is_refused(draw, runs, message):
    with pytest.raises(SMEError, match=message):
        draw(runs() if callable(runs) else runs)
