"""Figures: complete files in the requested format, and their content."""

import sys

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate, materialize
from sme_registry.errors import (
    MalformedDocumentError,
    MissingDependencyError,
    OptionError,
    PolicyError,
)

pytest.importorskip("matplotlib")

from sme_registry import plots
from sme_registry.evaluation import Perceptron
from sme_registry.plots.style import FORMATS
from sme_registry.statistics import smoothed
from tests.geometry import assert_readable

PLANE = SMESpec(state_dim=2, action_dim=2)
PROTOCOL = {"states_per_region": 100, "epsilons": [0.5, 1.0]}
SIGNATURES = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}


def half(observations):
    return np.full((len(observations), 2), 0.5)


@pytest.fixture(scope="module")
def report():
    return evaluate(half, PLANE, PROTOCOL, name=r"a $\frac$ name")


EPISODES = [
    {"step": 100 * (i + 1), "regret": 1.0 - i / 50, "cost": 0.1 - i / 500} for i in range(50)
]


@pytest.mark.parametrize("ending", FORMATS)
def test_the_same_figure_is_the_same_file_in_every_format(tmp_path, report, ending):
    first, second = tmp_path / "new" / f"1.{ending}", tmp_path / f"2.{ending}"
    for path in (first, second):
        plots.decay_curve(report, path)
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes().startswith(SIGNATURES[ending])
    if ending == "png":  # in a notebook, too
        assert plots.decay_curve(report)._repr_png_().startswith(SIGNATURES["png"])
    assert list(first.parent.iterdir()) == [first]


@pytest.mark.parametrize("name", ["figure.jpg", "figure"])
def test_unknown_formats_are_rejected_before_anything_is_drawn(tmp_path, report, name):
    with pytest.raises(OptionError, match=r"must end in \.png, \.pdf, \.svg"):
        plots.decay_curve(report, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_without_matplotlib_the_message_names_the_extra(tmp_path, report, monkeypatch):
    for module in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[plot\]"):
        plots.decay_curve(report, tmp_path / "figure.png")


def test_a_figure_that_fails_keeps_the_old_file_and_matplotlibs_settings(tmp_path, report):
    import matplotlib

    before = dict(matplotlib.rcParams)
    path = tmp_path / "map.png"
    path.write_bytes(b"old")
    for policy in (lambda o: np.zeros((len(o), 3)), lambda o: None):
        with pytest.raises(PolicyError):
            plots.similarity_map(policy, PLANE, path, resolution=4)
        assert path.read_bytes() == b"old"
    plots.decay_curve(report)
    assert dict(matplotlib.rcParams) == before


def test_decay_curve_shows_the_reports_numbers_and_every_reference(report):
    figure = plots.decay_curve(report)
    for axes, measure in zip(figure.axes, ("similarity", "normalised_regret"), strict=True):
        drawn = [tuple(line.get_ydata()) for line in axes.lines]
        for regions in (report.regions, *report.references.values()):
            assert tuple(getattr(region, measure) for region in regions) in drawn
        assert tuple(axes.lines[0].get_xdata()) == (0.0, 0.5, 1.0)
        assert "not comparable" in axes.get_xlabel()
    # "$\\frac$" as a formula would be an error
    assert figure.legends[0].get_texts()[0].get_text() == r"a \$\frac\$ name"
    assert figure.get_suptitle() == f"SME/{report.spec.content_name}"


def test_a_decay_below_0_is_within_its_axes():
    deep = evaluate("linear", "Complexity50", {"states_per_region": 500, "epsilons": [0.5, 1.0]})
    axes = plots.decay_curve(deep, measures=["similarity_decay"]).axes[0]
    lowest = min(line.get_ydata().min() for line in axes.lines if len(line.get_ydata()) == 3)
    assert axes.get_ylim()[0] < lowest < 0


def test_figures_of_one_task_name_it(report):
    figure = plots.similarity_map(half, "Plane1", resolution=4)
    assert "half on SME/Plane1-v1, L = 1" in figure.get_suptitle()
    other = evaluate(half, PLANE.derive(seed=1), PROTOCOL)
    assert plots.decay_curve([report, other]).get_suptitle() == ""
    other = evaluate(half, PLANE.derive(state_dim=3), PROTOCOL)
    label = plots.decay_curve([report, other]).axes[0].get_xlabel()
    assert "different S: these levels are not comparable" in label


def test_decay_curve_draws_references_once_for_each_task(report):
    again = report.model_copy(update={"policy": "again"})
    other = evaluate(half, PLANE.derive(seed=1), PROTOCOL)
    counts = []
    for reports in ([report], [report, again], [report, again, other]):
        axes = plots.decay_curve(reports, measures=["similarity"]).axes[0]
        counts.append(sum(len(line.get_xdata()) > 0 for line in axes.lines))
    assert counts == [1 + 5, 2 + 5, 3 + 5 + 5]
    assert len(plots.decay_curve(report, references=False).axes[0].lines) == 1


@pytest.mark.parametrize("n", [6, 7])
def test_decay_curve_of_a_team_has_a_line_for_each_agent(n):
    agents = [{"action_dim": 1 + i % 2} for i in range(n)]
    width = sum(agent["action_dim"] for agent in agents)
    team = SMESpec(state_dim=2, action_dim=width, team={"agents": agents})

    def spread(observations):
        shares = np.linspace(0.2, 0.8, n)[observations[:, 4:].argmax(axis=1)]
        return np.repeat(shares[:, None], min(n, 2), axis=1)

    report = evaluate(spread, team, PROTOCOL)
    figure = plots.decay_curve(report)
    for axes, measure in zip(figure.axes, ("similarity", "normalised_regret"), strict=True):
        drawn = [tuple(line.get_ydata()) for line in axes.lines]
        for scope in (report, *report.agents.values()):
            assert tuple(getattr(region, measure) for region in scope.regions) in drawn
    named = [text.get_text() for text in figure.legends[0].get_texts()]
    expected = [f"agent_{i}" for i in range(n)] if n < 7 else ["each of 7 agents"]
    assert named[: 1 + len(expected)] == ["spread", *expected]
    assert len(plots.decay_curve([report, report], references=False).axes[0].lines) == 2


def test_similarity_map_of_a_team_shows_its_joint_action():
    team = PLANE.derive(team={"agents": [{"action_dim": 1, "observes": [1]}, {"action_dim": 1}]})
    policies = {"agent_0": lambda o: o[:, :1], "agent_1": lambda o: o[:, :1]}
    figure = plots.similarity_map(policies, team, resolution=8, epsilon=1.0)
    drawn = figure.axes[0].images[0].get_array()
    side = -0.5 + (np.arange(8) + 0.5) / 4
    s = np.array([[x, y] for y in side for x in side])
    expected = materialize(team).similarity(s, s[:, ::-1]).reshape(8, 8)
    assert np.asarray(drawn) == pytest.approx(expected, abs=1e-6)


def test_similarity_map_shows_r_over_the_plane_beyond_the_unit_square():
    axes = plots.similarity_map(half, PLANE, resolution=8).axes[0]
    (image,) = axes.images
    assert image.get_extent() == [-0.5, 1.5, -0.5, 1.5]
    side = (np.arange(8) + 0.5) / 4 - 0.5
    task = materialize(PLANE)
    expected = [[task.similarity([x, y], [0.5, 0.5]) for x in side] for y in side]
    assert np.abs(np.asarray(image.get_array()) - expected).max() < 1e-6
    outline = axes.lines[0]
    assert set(zip(*outline.get_data(), strict=True)) == {(0, 0), (1, 0), (1, 1), (0, 1)}


def test_similarity_map_passes_the_time_to_the_policy():
    seen = set()

    def watching(observations):
        assert observations.dtype == np.float32
        seen.update(map(tuple, observations[:, 2:]))
        return half(observations)

    plots.similarity_map(watching, PLANE, resolution=4, time=0.25)
    assert seen == {(0.25, 0.0)}


def test_training_curve_reads_a_csv_and_ignores_an_incomplete_row(tmp_path):
    path = tmp_path / "episodes.csv"
    rows = [f"{i},{row['step']},{row['regret']}" for i, row in enumerate(EPISODES)]
    path.write_text("\n".join(["episode,step,regret", *rows, "51,51"]))
    drawn = (plots.training_curve(rows, window=5) for rows in (path, EPISODES))
    cloud, expected = (figure.axes[0].collections[0].get_offsets() for figure in drawn)
    assert len(cloud) == 50
    assert np.array_equal(cloud, expected)


def test_training_curve_is_the_median_of_the_last_episodes(figures):
    rng = np.random.default_rng(0)
    rows = [{"step": i, "regret": r} for i, r in enumerate(rng.random(30), start=1)]
    axes = plots.training_curve(rows, window=5).axes[0]
    regret = np.array([row["regret"] for row in rows])
    line = axes.lines[0]
    assert np.array_equal(line.get_ydata(), [np.median(regret[i - 5 : i]) for i in range(5, 31)])
    assert np.array_equal(line.get_xdata(), np.arange(5, 31))
    assert not figures  # nothing was written


def test_the_episodes_of_parallel_lanes_give_one_increasing_line():
    rng = np.random.default_rng(0)
    lengths = rng.integers(20, 100, size=(8, 30))
    step = 8 * np.cumsum(lengths, axis=1).ravel()  # lane after lane, so out of order
    regret = rng.random(step.size)
    x, y, window = smoothed(step, regret)
    assert window == 24
    assert np.all(np.diff(x) > 0)
    order = np.argsort(step, kind="stable")
    for at, median in zip(x[::7], y[::7], strict=True):
        ended = regret[order][: np.sum(step <= at)]
        assert median == np.median(ended[-window:])
    axes = plots.training_curve({"step": step, "regret": regret}).axes[0]
    assert np.all(np.diff(axes.lines[0].get_xdata()) > 0)
    # The window holds all episodes that end at one step.
    x, _, window = smoothed(np.repeat([100, 200, 300], 64), np.arange(192.0))
    assert (window, x.tolist()) == (64, [100, 200, 300])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "contains no finished episode"),
        ("a,b\n1,2\n", "must have numbers for step and regret"),
        ("step,regret\n1,x\n", "must have numbers for step and regret"),
        ("step,regret\n1,nan\n", "must have numbers for step and regret"),
        (None, "cannot be read"),
        ("x" * 200_000, "cannot be read"),
    ],
)
def test_training_curve_rejects_invalid_logs(tmp_path, content, message):
    path = tmp_path / "episodes.csv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(OptionError, match=message):
        plots.training_curve(path, tmp_path / "figure.png")


def test_learning_curve_is_the_median_and_the_quartiles_over_runs():
    step = np.arange(1, 101)
    runs = {"A": [{"step": step, "regret": np.full(100, level)} for level in (0.1, 0.2, 0.6)]}
    axes = plots.learning_curve({**runs, "B": [{"step": step, "regret": step / 100}]}).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines) == ["A (n = 3)", "B", "optimal"]
    assert set(lines["A (n = 3)"].get_ydata()) == {0.2}
    (band,) = [drawn for drawn in axes.collections if drawn.get_paths()]  # none of a single run
    assert np.allclose(
        sorted(set(band.get_paths()[0].vertices[:, 1].round(6))), [0.15, 0.4], atol=1e-6
    )


def test_learning_curve_of_a_table_is_that_of_its_runs():
    pandas = pytest.importorskip("pandas")
    rng = np.random.default_rng(0)
    runs = {m: [{"step": np.arange(40), "regret": rng.random(40)} for _ in "ab"] for m in "XY"}
    table = pandas.concat(
        pandas.DataFrame(run).assign(method=method, seed=seed)
        for method, each in runs.items()
        for seed, run in enumerate(each)
    )
    one, other = (plots.learning_curve(x, window=4).axes[0].lines for x in (runs, table))
    for left, right in zip(one, other, strict=True):
        assert left.get_label() == right.get_label()
        assert np.array_equal(left.get_data(), right.get_data())


def test_decay_curve_reads_files_and_folders_of_reports(tmp_path, report):
    path = report.write(tmp_path / "evaluation.json")
    measures = ["similarity"]
    expected = plots.decay_curve(report, measures=measures).axes[0].lines[0].get_ydata()
    methods = {"A": path, "B": [str(tmp_path)], "C": report}
    for reports in (path, str(path), tmp_path, [tmp_path], methods):
        lines = plots.decay_curve(reports, measures=measures).axes[0].lines
        assert np.array_equal(lines[0].get_ydata(), expected)
    for missing in (tmp_path / "none.json", tmp_path / "none"):
        with pytest.raises(MalformedDocumentError, match="none"):
            plots.decay_curve(missing)


def test_learning_curve_reads_one_run_alone_and_the_files_and_folders_of_runs(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text("step,regret\n10,0.5\n20,0.25\n")
    alone = {"step": [10, 20], "regret": [0.5, 0.25]}
    for runs in (tmp_path, str(tmp_path), alone, [tmp_path, path]):
        line = plots.learning_curve({"TD3": runs}).axes[0].lines[0]
        assert (line.get_ydata()[0], line.get_ydata()[-1]) == (0.5, 0.25)


def test_decay_curve_of_methods_is_the_iqm_over_their_runs(report):
    other = evaluate(lambda o: np.full((len(o), 2), 0.4), PLANE.derive(seed=1), PROTOCOL)
    axes = plots.decay_curve({"A": [report, other], "B": [report]}, measures=["similarity"]).axes[0]
    runs = np.array([[region.similarity for region in each.regions] for each in (report, other)])
    lines = {line.get_label(): np.array(line.get_ydata()) for line in axes.lines}
    assert np.allclose(lines["A (n = 2)"], runs.mean(axis=0))
    assert np.array_equal(lines["B"], runs[0])
    assert len([band for band in axes.collections if band.get_paths()]) == 1
    linear = [each.references["linear"] for each in (report, other)]
    assert np.allclose(
        lines["linear"], np.mean([[r.similarity for r in one] for one in linear], axis=0)
    )


def test_references_that_coincide_are_one_line_with_both_names():
    report = evaluate(half, PLANE, {"states_per_region": 40_000, "epsilons": [0.5]})
    for axes in plots.decay_curve(report).axes:
        drawn = {line.get_label(): line for line in axes.lines if line.get_visible()}
        assert "best constant = constant ½" in drawn
        assert not {"best constant", "constant ½"} & set(drawn)
    apart = report.model_copy(update={"references": dict(report.references)})
    worse = [
        region.model_copy(update={"similarity": region.similarity - 0.1})
        for region in report.references["best_constant"]
    ]
    apart.references["best_constant"] = tuple(worse)
    labels = {line.get_label() for line in plots.decay_curve(apart).axes[0].lines}
    assert {"best constant", "constant ½"} <= labels


def test_figures_are_drawn_in_the_callers_axes_and_leave_their_legend_to_the_caller(report):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    panels = figure.subplots(2, 2)
    assert plots.decay_curve(report, ax=panels[0]) is figure
    assert plots.training_curve(EPISODES, ax=panels[1, 0]) is figure
    assert plots.learning_curve({"A": [EPISODES]}, ax=panels[1, 1]) is figure
    assert all(axes.lines and axes.get_legend() is None for axes in panels.flat)
    assert not figure.legends
    with pytest.raises(OptionError, match="ax: 1 axes for 2 panels"):
        plots.decay_curve(report, ax=panels[0, 0])


def test_save_figure_writes_every_format_beside_the_others_without_type_3_fonts(tmp_path, report):
    written = plots.save_figure(plots.decay_curve(report), tmp_path / "a.b", FORMATS)
    assert [path.name for path in written] == ["a.b.png", "a.b.pdf", "a.b.svg"]
    pdf = written[1].read_bytes()
    assert b"/Type3" not in pdf
    assert b"TrueType" in pdf or b"CIDFontType2" in pdf
    with pytest.raises(OptionError, match="must end in"):
        plots.save_figure(plots.decay_curve(report), tmp_path / "c", ["jpg"])


LONG = [f"a method with a long name and settings (learning_rate = 0.000{i})" for i in range(1, 9)]


def test_eight_methods_with_long_names_leave_every_figure_readable(report):
    named = [report.model_copy(update={"policy": name}) for name in LONG]
    tasks = [evaluate(half, PLANE.derive(seed=i), PROTOCOL, name=LONG[i]) for i in range(2)]
    runs = {name: [EPISODES, EPISODES] for name in LONG}
    for figure in (
        plots.decay_curve(named),
        plots.decay_curve({name: [report, report] for name in LONG[:7]}),
        plots.decay_curve(tasks),
        plots.learning_curve(runs, title=LONG[0]),
        plots.training_curve(EPISODES, title=LONG[0]),
        plots.cost_curve(EPISODES),
        plots.similarity_map(half, PLANE, resolution=4, name=LONG[0][:30]),
    ):
        assert_readable(figure)


def test_an_unreadable_figure_is_noticed():
    from matplotlib.figure import Figure

    figure = Figure()
    figure.add_subplot().plot([0, 1], [0, 1], label="covering")
    figure.axes[0].legend()
    with pytest.raises(AssertionError, match="covers a panel"):
        assert_readable(figure)


def test_colours_of_a_map_cover_its_similarities_and_the_scale_says_so():
    from sme_registry.plots.maps import colour_scale

    assert colour_scale([0.713, np.nan, 0.76]) == pytest.approx((0.70, 0.80))
    assert colour_scale([0.9, 0.95]) == pytest.approx((0.9, 0.95))
    assert colour_scale([1.0, 1.0]) == pytest.approx((0.95, 1.0))
    figure = plots.similarity_map(half, PLANE, resolution=16)
    image = figure.axes[0].images[0]
    low, high = image.get_clim()
    assert low <= image.get_array().min() < low + 0.05
    assert high - 0.05 < image.get_array().max() <= high
    assert f"colours from {low:.2f} to {high:.2f}" in figure.axes[1].get_ylabel()


EXTENDED = SMESpec(
    state_dim=3, action_dim=2, safety={"tightness": 0.3}, observation={"distractors": 4}
)
EXTENSIONS = ("reward_against_cost", "sensitivity_bars", "layer_probes")


@pytest.fixture(scope="module")
def extended():
    random = np.random.default_rng(0)
    layers = [
        (random.normal(size=(9, 5)), np.zeros(5), "tanh"),
        (random.normal(size=(5, 2)), np.full(2, 0.5), "sigmoid"),
    ]
    return evaluate(Perceptron(layers), EXTENDED, PROTOCOL, name="net")


@pytest.mark.parametrize("name", EXTENSIONS)
def test_figures_of_safety_and_observation_are_readable(extended, name):
    draw = getattr(plots, name)
    assert_readable(draw({name: [extended] * 3 for name in LONG[:3]}))
    assert_readable(draw([extended.model_copy(update={"policy": name}) for name in LONG]))


def test_figures_of_safety_and_observation_show_the_numbers_of_the_report(extended):
    inside, outside = plots.reward_against_cost(extended).axes
    safety, observation = extended.safety, extended.observation
    for axes, regions in ((inside, slice(0, 1)), (outside, slice(1, None))):
        drawn = {tuple(np.ravel(line.get_xydata())) for line in axes.lines}
        shown = ("optimal", "safe_projection", "shrunk_optimal", "constant")
        for scores in (safety.regions, *(safety.references[name] for name in shown)):
            of = [(each.cost, each.step_reward) for each in scores[regions]]
            expected = np.mean(of, axis=0)
            assert any(len(p) == 2 and np.allclose(p, expected, atol=1e-12) for p in drawn)

    (axes,) = plots.sensitivity_bars(extended).axes
    far = np.mean([region.normalised_regret for region in observation.distractor_regions])
    sensitivity = observation.sensitivity[0].sensitivity
    expected = [extended.wd_regret, extended.ood_regret, far, sensitivity]
    assert [bar.get_height() for bar in axes.patches] == pytest.approx(expected, abs=1e-12)

    left, right = plots.layer_probes(extended).axes
    probes = observation.probes
    assert list(left.lines[0].get_ydata()) == [probe.state_r2 for probe in probes]
    assert list(right.lines[0].get_ydata()) == [probe.distractor_r2 for probe in probes]
    assert [tick.get_text() for tick in left.get_xticklabels()] == ["observation", "1"]


def test_runs_with_other_layers_are_not_one_method(extended):
    observation = extended.observation
    shorter = observation.model_copy(update={"probes": observation.probes[:1]})
    other = extended.model_copy(update={"observation": shorter})
    with pytest.raises(OptionError, match="different numbers of layers"):
        plots.layer_probes({"net": [extended, other]})


def test_a_decay_curve_of_tasks_with_and_without_limits_shows_what_they_share(extended, report):
    figure = plots.decay_curve({"a": [extended], "b": [report]}, measures=["similarity"])
    labels = {line.get_label() for line in figure.axes[0].lines}
    assert "optimal" in labels
    assert "safe projection" not in labels
    assert "safe projection" in {
        line.get_label() for line in plots.decay_curve(extended).axes[0].lines
    }


def test_commands_write_the_figures_for_which_the_report_has_numbers(
    tmp_path, extended, report, monkeypatch
):
    from sme_registry.plots.reports import write_evaluation

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *args, **options: None)
    names = {path.stem for path in write_evaluation(extended, tmp_path / "extended")}
    assert names == {"decay_curve", *EXTENSIONS}
    assert {path.stem for path in write_evaluation(report, tmp_path / "plain")} == {"decay_curve"}


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda report: plots.decay_curve([]), "must be one or more evaluation reports"),
        (
            lambda report: plots.decay_curve(3),
            "reports=3: must be one or more EvaluationReports, paths of",
        ),
        (lambda report: plots.decay_curve(report, measures=["mae"]), "measures="),
        (
            lambda report: plots.decay_curve(
                {"A": [report, evaluate(half, PLANE, PROTOCOL | {"epsilons": [0.3]})]}
            ),
            "different regions",
        ),
        (lambda report: plots.similarity_map(half, "Default-v1"), "state_dim=8: must be 2"),
        (
            lambda report: plots.similarity_map(half, PLANE.derive(observation={"distractors": 1})),
            "must be absent for a map",
        ),
        (
            lambda report: plots.similarity_map(half, PLANE, epsilon=0.0),
            r"epsilon=0.0: must be a finite number in",
        ),
        (
            lambda report: plots.similarity_map(half, PLANE, resolution=1),
            r"resolution=1: must be an integer in \[2, 2,000\]",
        ),
        (lambda report: plots.learning_curve({}), "one or more runs"),
        (lambda report: plots.learning_curve(3), "runs=3: must map each method's name to its runs"),
        (lambda report: plots.learning_curve({"A": "no/such/run"}), "no/such/run: cannot be read"),
        (
            lambda report: plots.learning_curve({"regret": [1.0, 2.0], "step": [1]}),
            "columns step and regret of equal length",
        ),
        (
            lambda report: plots.learning_curve({"A": [EPISODES[:5], EPISODES[40:]]}),
            "share no steps",
        ),
        (plots.reward_against_cost, "is of a task without limits"),
        (plots.sensitivity_bars, "is of a task without distractors"),
        (plots.layer_probes, "has no probes"),
    ],
)
def test_bad_input_is_refused(report, draw, message):
    with pytest.raises(OptionError, match=message):
        draw(report)
