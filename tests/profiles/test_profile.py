"""Profiles: their plan and references, what follows from their rows, how they are run and shown."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import sme_registry
from sme_registry import Profile
from sme_registry.errors import OptionError, SpecError, UnknownNameError
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.profiles import document, page, run
from sme_registry.profiles.document import AXES, DEFAULT, REFERENCES, TWO_LAYERS, ProfileRow
from sme_registry.profiles.page import write_page
from sme_registry.spec import StudyAlgorithm, StudyFile, StudyPlan
from sme_registry.studies import run_study
from sme_registry.studies.ledger import Ledger
from tests import commands

PLAN = document.plan_file()
RELEASED = {  # levels that the catalogue has as tasks
    "state_dim": "StateDim{}", "action_dim": "ActionDim{}", "k": "Interval{}",
    "r_min": "MinReward{}", "D": "Survival{}", "shaping-scale": "Foresight{}",
    "noise-reward": "NoisyReward{}", "observation-distractors": "Distract{}Noise",
}  # fmt: skip
SHORT = {"default", "k-25", "D-0_5", TWO_LAYERS}  # levels of the small plan
AXIS = {axis.harder[0].rpartition("-")[0]: axis for axis in AXES}


class TestPlan:
    def test_a_quick_look_has_the_bases_and_the_hardest_level_of_each_axis(self):
        bases = DEFAULT, TWO_LAYERS
        hardest = (list(axis.levels)[-1] for axis in AXES)
        assert run.quick_classes() == (*bases, *hardest)

    def test_its_levels_are_the_catalogues_tasks_in_five_draws(self):
        classes = {member.name: member for member in PLAN.plan.classes}
        assert set(classes) == {name for axis in AXES for name in axis.levels}
        assert all(len(axis.levels) == 3 for axis in AXES)
        for member in classes.values():
            assert member.seeds == (1, 2, 3, 4, 5)
        for stem, name in RELEASED.items():
            for level in AXIS[stem].harder:
                value = level.rpartition("-")[2].replace("_", ".")
                as_id = f"{float(value):.2f}"[-2:] if stem in ("r_min", "D") else value
                as_id = f"{float(value) * 100:.0f}" if stem == "noise-reward" else as_id
                task = sme_registry.load(name.format(as_id))
                assert classes[level].instances[0] == task.derive(seed=1), level

    def test_a_harder_level_differs_from_its_base_in_its_axis_alone(self):
        settings = {m.name: m.setting.every_field() for m in PLAN.plan.classes}
        for stem, axis in AXIS.items():
            for level in axis.harder:
                base, harder = settings[axis.base], settings[level]
                changed = {name for name in base if base[name] != harder[name]}
                assert changed - {"policy_init"} == {stem.partition("-")[0]}

    def test_more_draws_are_other_draws(self):
        algorithm = next(a for a in PLAN.plan.algorithms if a.name == "linear")
        five, seven = (run.study_of(algorithm, seeds=seeds).plan.cells for seeds in (None, 7))
        assert {each.cell.digest for each in five} < {each.cell.digest for each in seven}
        of_default = [each.cell.spec.digest for each in seven if each.class_name == DEFAULT]
        assert len({*of_default}) == 7


class TestReferences:
    def test_each_that_ships_is_of_this_plan_and_says_of_what(self):
        references = Profile.references()
        assert next(iter(references)) == "PPO"
        known = {algorithm.name: algorithm for algorithm in PLAN.plan.algorithms}
        for name, profile in references.items():
            assert profile.algorithm == known[name]
            assert profile.plan_digest == PLAN.digest
            assert profile.protocol_digest == PLAN.plan.protocol.digest
            assert not profile.failures
            places = [(row.class_name, row.run) for row in profile.rows]
            assert len(set(places)) == len(places)
            assert {"numpy", "sme_registry"} <= {*profile.versions}
            assert {*profile.versions} >= ({"jaxlib"} if profile.learns else set())

    def test_those_that_are_quick_are_whole_and_all_are_small(self):
        references = Profile.references()
        for name in ("PPO", "PPO (gamma 0)", "linear", "constant"):
            assert len(references[name].rows) == references[name].planned == 95
        assert sum(path.stat().st_size for path in REFERENCES.glob("*")) < 300_000

    def test_the_constant_is_where_normalised_regret_is_one(self):
        constant = Profile.references()["constant"]
        assert all(row.wd_regret == 1.0 for row in constant.rows)
        assert all(math.isnan(constant.robustness(axis).value) for axis in AXES)


def made(regret, *, name="mine", steps=20_000, draws=5, evaluations=20):
    """A profile whose N₀ is a function of the level and the draw; None for no run."""
    values = {(m.name, i): regret(m.name, i) for m in PLAN.plan.classes for i in range(draws)}
    rows = [
        ProfileRow(
            class_name=level, run=i, wd_regret=value, ood_regret=value, ood_decay=0.1,
            online_regret=0.2, evaluations=evaluations,
            steps_to_half=1000 * (i + 1) if value < 0.5 else None,
        )
        for (level, i), value in values.items() if value is not None
    ]  # fmt: skip
    return Profile(
        algorithm=StudyAlgorithm(name=name, uses=name),
        plan=PLAN.versioned_name,
        plan_digest=PLAN.digest,
        protocol_digest=PLAN.plan.protocol.digest,
        steps=steps,
        seeds=draws,
        classes=[member.name for member in PLAN.plan.classes],
        rows=rows,
        versions={},
    )


class TestFacts:
    def test_robustness_is_the_share_of_performance_that_is_kept(self):
        regrets = {DEFAULT: 0.2, "k-5": 0.4, "k-25": 0.8}
        profile = made(lambda level, i: regrets.get(level, 0.2) + 0.01 * (i - 2))
        kept = profile.robustness(AXIS["k"])
        assert kept.value == pytest.approx((0.6 / 0.8 + 0.2 / 0.8) / 2)
        assert kept.low < kept.value < kept.high
        assert kept.draws == 5
        assert profile.robustness(AXIS["D"]).value == pytest.approx(1.0)

    def test_foresight_and_noise_are_relative_to_two_layers(self):
        regrets = {TWO_LAYERS: 0.5, "noise-reward-0_3": 0.75, "noise-reward-1": 0.75}
        profile = made(lambda level, i: regrets.get(level, 0.0))
        assert profile.robustness(AXIS["noise-reward"]).value == pytest.approx(0.5)

    def test_it_is_unknown_where_nothing_was_learnt_or_a_level_is_missing(self):
        unlearnt = made(lambda level, i: 0.95)
        assert math.isnan(unlearnt.robustness(AXIS["k"]).value)
        assert "hardly better than the constant" in unlearnt.sentences([])[0]
        partial = made(lambda level, i: None if level == "k-25" else 0.1)
        assert math.isnan(partial.robustness(AXIS["k"]).value)
        assert not math.isnan(partial.robustness(AXIS["D"]).value)
        one_draw_less = made(lambda level, i: None if (level, i) == ("k-25", 3) else 0.1)
        assert one_draw_less.robustness(AXIS["k"]).draws == 4

    def test_steps_to_half_are_the_median_over_draws(self):
        assert made(lambda level, i: 0.1).steps_to_half() == 3000
        assert made(lambda level, i: 0.1 if i < 3 else 0.7).steps_to_half() == 3000
        assert math.isinf(made(lambda level, i: 0.1 if i < 2 else 0.7).steps_to_half())
        assert made(lambda level, i: 0.1, evaluations=1).steps_to_half() is None

    def test_verdicts_are_of_pairs_and_fewer_than_five_are_an_indication(self):
        theirs = made(lambda level, i: 0.5 + 0.05 * i, name="PPO")
        better = made(lambda level, i: 0.3 + 0.05 * i)
        contrasts = better.contrasts(theirs)
        assert {contrast.verdict for contrast in contrasts.values()} == {"better"}
        k = contrasts[AXIS["k"].label]
        assert k.value == pytest.approx(-0.2)
        assert k.draws == 10  # pairs, of two levels
        few = made(lambda level, i: 0.3 + 0.05 * i, draws=3).contrasts(theirs)
        assert {contrast.verdict for contrast in few.values()} == {"indication"}
        noise = made(lambda level, i: 0.6 + (-1) ** i * 0.2)
        assert noise.contrasts(theirs)["the default"].verdict == "open"
        text = better.sentences([theirs])[-1]
        assert text.startswith("Against PPO")
        assert "better on" in text

    def test_an_indication_says_on_which_side_it_is(self):
        theirs = made(lambda level, i: 0.5 + 0.05 * i, name="PPO", draws=2)
        mixed = made(lambda level, i: (0.3 if "k-" in level else 0.7) + 0.05 * i, draws=2)
        text = mixed.sentences([theirs])[-1]
        assert "as an indication only, worse on " in text
        assert "as an indication only, better on reward interval k (−0.20" in text

    def test_where_it_breaks_most_says_which_intervals_overlap(self):
        regrets = {"k-25": 0.6, "k-5": 0.6, "D-0_5": 0.58, "D-0_25": 0.58}
        spread = made(lambda level, i: regrets.get(level, 0.2) + 0.03 * (i - 2))
        text = spread.sentences([])[0]
        assert "breaks most along reward interval k" in text
        assert "Its interval overlaps with those along survival threshold D (0.53 [0.49" in text
        exact = made(lambda level, i: regrets.get(level, 0.2))
        assert "overlap" not in exact.sentences([])[0]

    def test_missing_levels_are_not_called_a_bad_performance(self):
        text, *_ = made(lambda level, i: 0.1 if level == DEFAULT else None).sentences([])
        assert "hardly better" not in text
        assert "no axis has runs" in text

    def test_steps_to_half_count_the_draws_that_did_not_reach_it(self):
        half = made(lambda level, i: 0.1 + 0.6 * i, draws=2)
        assert "in 1 of 2 draws it never fell to ½" in half.sentences([])[1]

    def test_a_reference_that_does_not_learn_has_no_training(self):
        linear = Profile.references()["linear"]
        assert linear.steps_to_half() is None
        assert linear.sentences([])[1].endswith("; it does not learn.")
        assert "no training, 95 of 95 runs" in str(linear)

    def test_others_have_the_robustness_of_a_quick_profiles_levels(self, tmp_path):
        quick = made(lambda level, i: 0.2).model_copy(update={"classes": run.quick_classes()})
        theirs = made(lambda level, i: {"k-5": 0.3, "k-25": 0.6}.get(level, 0.2), name="PPO")
        axis = AXIS["k"]
        assert theirs.robustness(axis).value == pytest.approx((0.7 / 0.8 + 0.4 / 0.8) / 2)
        assert theirs.robustness(axis, quick.classes).value == pytest.approx(0.4 / 0.8)
        write_page(quick, tmp_path, [theirs])
        page = (tmp_path / "profile.html").read_text()
        assert "details::details-content { content-visibility: visible" in page  # when printed
        row = re.search(r">reward interval k<.*?</tr>", page, re.S)
        assert "1.00" in row[0]
        assert "0.50" in row[0]

    def test_what_is_outside_a_figure_is_marked_at_its_edge(self):
        low = made(lambda level, i: 0.2 if level in (DEFAULT, TWO_LAYERS) else 2.5 + 0.01 * i)
        for figure in (low.draw([]), page.draw_robustness(low, [])):
            for axes in figure.axes:
                (left, right), (bottom, top) = axes.get_xlim(), sorted(axes.get_ylim())
                for line in axes.lines:
                    x, y = np.array(line.get_xdata(), float), np.array(line.get_ydata(), float)
                    if line.get_marker() not in ("", "None"):
                        assert ((left <= x) & (x <= right)).all()
                        assert ((bottom <= y) & (y <= top)).all()

    def test_other_steps_and_the_algorithm_itself_are_not_compared(self):
        ppo, linear = (Profile.references()[name] for name in ("PPO", "linear"))
        assert made(lambda level, i: 0.1).comparable([ppo, linear]) == [ppo, linear]
        assert made(lambda level, i: 0.1, steps=500).comparable([ppo, linear]) == [linear]
        assert ppo.comparable([ppo, linear]) == [linear]

    def test_one_of_the_same_name_is_told_apart(self, tmp_path):
        ppo = Profile.references()["PPO"]
        mine = made(lambda level, i: 0.1 if level in (DEFAULT, TWO_LAYERS) else 0.91, name="PPO")
        (other,) = mine.comparable([ppo])
        assert (other.name, other.rows) == ("reference PPO", ppo.rows)
        axis = AXIS["k"]
        table = page._robustness(mine, [other]).frame.set_index("axis").loc[axis.label]
        assert table["PPO"] == str(mine.robustness(axis)) == "0.10 [0.10, 0.10]"
        assert table["reference PPO"] == str(ppo.robustness(axis))
        write_page(mine, tmp_path)
        text = (tmp_path / "profile.html").read_text()
        assert "Against reference PPO, by the difference of N₀: worse on" in text
        assert "Against TD3" in text

    def test_sentences_compare_with_those_that_are_given(self):
        mine, theirs = made(lambda level, i: 0.1), made(lambda level, i: 0.3, name="other")
        assert "Against other, " in mine.sentences([theirs])[-1]
        apart = made(lambda level, i: 0.3 if i > 2 else None, name="other")
        assert len(made(lambda level, i: 0.1, draws=2).sentences([apart])) == 2

    def test_a_file_reads_back_and_a_newer_one_is_refused(self, tmp_path):
        profile = made(lambda level, i: 0.1 + 0.01 * i)
        path = profile.write(tmp_path / "profile.json")
        assert Profile.read(path) == profile
        path.write_text(json.dumps(profile.to_dict() | {"schema_version": 2}))
        with pytest.raises(SpecError, match="Upgrade"):
            Profile.read(path)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A plan of four levels, with few states, in a working directory of its own."""
    fields = PLAN.plan.to_dict() | {
        "protocol": resolve_protocol("quick-v1").to_dict(), "steps": 300, "evaluations": 3,
    }  # fmt: skip
    fields["classes"] = [member for member in fields["classes"] if member["name"] in SHORT]
    plan = StudyPlan.from_dict(fields)
    file = StudyFile(name="profile", digest=plan.digest, plan=plan)
    for module in (document, run):
        monkeypatch.setattr(module, "plan_file", lambda: file)
    monkeypatch.setattr(run, "quick_classes", lambda: (DEFAULT, "k-25"))
    monkeypatch.chdir(tmp_path)
    return file


def made_of(function, **options):
    return sme_registry.profile(function, seeds=2, progress=False, **options)


@pytest.fixture
def learner():
    """Yields a bad policy, and then the optimal one; raises on the second draw of k = 25."""

    def learner(env, steps, seed, action=0.0):
        learner.calls.append(seed)
        env.reset(seed=seed)
        task = env.unwrapped.task
        for i in range(steps):
            *_, terminated, truncated, _ = env.step(np.full(task.spec.action_dim, action))
            if terminated or truncated:
                env.reset()
            if i == 150:
                yield lambda observations: np.ones((len(observations), task.spec.action_dim))
        if seed == 1 and task.spec.k == 25:
            raise RuntimeError("boom")
        yield lambda observations: 2.0 * task.optimal_action(observations[:, :8]) - 1.0

    learner.calls = []
    return learner


class TestRun:
    def test_it_is_a_study_with_a_page_and_is_continued(self, small, tmp_path, learner):
        profile = made_of(learner)
        folder = tmp_path / "runs" / "profile-learner"
        assert {path.name for path in folder.glob("profile.*")} == {
            "profile.html", "profile.json", "profile.pdf",
        }  # fmt: skip
        assert Profile.read(folder / "profile.json") == profile
        assert len(profile.rows) == 2 * len(SHORT) - 1
        (failure,) = profile.failures
        assert (failure.class_name, failure.run) == ("k-25", 1)
        assert "boom" in failure.error
        page = (folder / "profile.html").read_text()
        assert "boom" in page
        assert "http://" not in page.replace("http://www.w3.org", "")
        assert "with at most 300 steps each" in page
        row = next(row for row in profile.rows if row.class_name == DEFAULT)
        assert row.wd_regret < 1e-3
        assert row.evaluations == 3
        assert 100 < row.steps_to_half <= 300  # the first policy was bad
        assert profile.algorithm.source.startswith("sha256:")
        before = len(learner.calls)
        assert made_of(learner) == profile
        assert len(learner.calls) == before  # nothing was trained again
        assert made_of(learner, quick=True).planned == 2 * 2
        with pytest.raises(OptionError, match="holds the study"):
            made_of(learner, hyperparameters={"action": 0.5}, folder=folder)
        plan = StudyPlan.from_dict(small.plan.to_dict() | {
            "classes": small.plan.to_dict()["classes"][:1],
            "algorithms": [profile.algorithm.to_dict()],
        })  # fmt: skip
        Ledger(folder).write_plan(StudyFile(name="another", digest=plan.digest, plan=plan))
        with pytest.raises(OptionError, match="holds the study another"):
            made_of(learner)

    def test_what_a_function_may_not_do_is_a_failed_run_that_says_so(self, small):
        def long(env, steps, seed):
            env.reset()
            while True:
                *_, terminated, truncated, _ = env.step(env.action_space.sample())
                if terminated or truncated:
                    env.reset()

        def nothing(env, steps, seed):
            pass

        def narrow(env, steps, seed):
            return lambda observations: np.zeros((len(observations), 3))

        expected = {long: "takes more than 300 steps", nothing: "returned None", narrow: "4"}
        for function, message in expected.items():
            with pytest.raises(OptionError, match=f"no finished run .*{message}"):
                made_of(function, quick=True)

    def test_what_cannot_be_run_is_refused_before(self, small, learner):
        def other(env, n):
            return None

        with pytest.raises(OptionError, match="cannot be called with an environment"):
            made_of(other)
        with pytest.raises(OptionError, match="must be a function"):
            made_of(3)
        with pytest.raises(OptionError, match="steps=0: must be"):
            made_of(learner, steps=0)
        with pytest.raises(OptionError, match="jobs=2: must be 1"):
            made_of(learner, jobs=2)
        assert not Path("runs").exists()

    def test_runs_of_a_study_that_covers_it_are_a_profile(self, small, tmp_path):
        algorithms = [a for a in small.plan.algorithms if a.name in ("linear", "constant")]
        plan = small.plan.model_copy(update={"algorithms": tuple(algorithms), "seeds": 2})
        file = StudyFile(name="mine", digest=plan.digest, plan=plan)
        options = {"executor": "in-process", "progress": False}
        run_study(file, "study", only=["class=D-0_5"], **options)
        with pytest.raises(OptionError, match="no finished run on the default"):
            run.profile_of("study", "linear")
        run_study(file, "study", only=["class=default", "algorithm=linear"], **options)
        profile = run.profile_of("study", "linear")
        assert {row.class_name for row in profile.rows} == {DEFAULT, "D-0_5"}
        assert profile.planned == 2 * len(SHORT)
        write_page(profile, tmp_path / "out", [])
        page = (tmp_path / "out" / "profile.html").read_text()
        assert "4 of 8 finished, 4 not run" in page
        with pytest.raises(UnknownNameError, match="algorithm=None: must be 'linear' or"):
            run.profile_of("study")
        run_study(file, "study", only=["class=k-25", "algorithm=linear"], **options)
        quick = run.profile_of("study", "linear", classes=run.quick_classes())
        assert (quick.planned, len(quick.rows)) == (2 * 2, 2 * 2)


class TestCommand:
    def test_a_reference_is_shown(self):
        text = commands.good("profile", "show", "ppo").stdout
        assert "PPO  20,000 steps, 95 of 95 runs" in text
        shown = json.loads(commands.good("profile", "show", "PPO", "--json").stdout)
        assert Profile.from_dict(shown) == Profile.references()["PPO"]

    def test_what_is_not_clear_is_refused(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("mine.py").write_text("def train(env, steps, seed): pass\n")
        Path("json.py").write_text("")
        for arguments, message in {
            (): "Give a FILE",
            ("mine.py", "-a", "PPO"): "Leave one out",
            ("mine.py", "more"): "one argument too many",
            ("none.py",): "must be a Python file",
            ("mine.py:missing",): "has no function 'missing'",
            ("show", "PPOO"): "Did you mean 'PPO'",
            ("--runs", "none"): "holds no study",
            ("--runs", "none", "--quick"): "holds no study",
            ("--runs", "none", "--jobs", "2"): "--jobs: is for a training",
            ("show", "PPO", "--quick"): "--quick: is not for show",
            ("--runs", "none", "--name", "x"): "--name: is for a training",
            ("/usr/lib/python3/none.py",): "must be a Python file",
        }.items():
            assert message in commands.refused("profile", *arguments), arguments
        assert not Path("runs").exists()
