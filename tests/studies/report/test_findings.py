"""Findings of a study: verdicts that the tables support, each with a sentence on the page."""

import dataclasses
import html
import math
import re

import pytest

from sme_registry.studies.budget import scaled
from sme_registry.studies.report.analysis import ENOUGH_RUNS, change_verdict
from sme_registry.studies.report.design import SEVERAL
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.texts import comparison_caveats
from tests.studies.finished import analysed, found, rows_of, with_tables

pytest.importorskip("matplotlib")

from sme_registry.studies.report.write import page

SINGLE = {"low": math.nan, "high": math.nan, "pairs": 1}


def contrasted(analysis, class_name, fields):
    """With another contrast of Alpha's regret within the distribution."""
    rows = analysis.tables["contrasts"].copy()
    at = rows[["class_name", "algorithm", "metric"]] == [class_name, "Alpha", "wd_regret"]
    for name, value in fields.items():
        rows.loc[at.all(axis=1), name] = value
    rows["enough_pairs"] = rows.pairs >= ENOUGH_RUNS
    rows["verdict"] = [
        change_verdict(r.change, r.low, r.high, enough=r.enough_pairs) for r in rows.itertuples()
    ]
    return with_tables(analysis, contrasts=rows)


def of_alpha(analysis):
    return found(analysis, section="tasks", algorithm="Alpha")


def test_findings_name_the_property_that_each_learner_was_built_to_fail_at(analysis):
    alpha, beta = of_alpha(analysis), found(analysis, section="tasks", algorithm="Beta")
    worst = alpha["worst WD regret"]
    assert (worst.verdict, worst.class_name, worst.runs) == ("broken", "r_min-0_5", 5)
    assert worst.sentence.startswith("Alpha is broken by minimum reward r_min: on r_min-0_5 its WD")
    assert alpha["certainty of WD regret"].verdict == "certain"
    assert alpha["worst OOD regret"].verdict == "broken"
    worst = beta["worst WD regret"]
    assert (worst.verdict, worst.class_name) == ("broken_few", "k-25")


def test_every_axis_has_a_verdict_those_that_hurt_first(analysis):
    rows = rows_of(findings(analysis), algorithm="Alpha", question="axis")
    assert list(zip(rows.class_name, rows.verdict, strict=True)) == [
        ("r_min-0_5", "worse"), ("k-25", "worse"), ("complexity-10", "open"), ("plane", "open"),
    ]  # fmt: skip


def test_a_lower_regret_is_told_by_the_value_of_the_field_and_makes_the_headline(analysis):
    fields = {"change": -0.3, "low": -0.4, "high": -0.2}
    lower = contrasted(analysis, "r_min-0_5", fields)
    for name in ("k-25", "complexity-10", "plane"):
        lower = contrasted(lower, name, {"change": 0.0, "low": -0.1, "high": 0.1})
    of_axes = rows_of(findings(lower), algorithm="Alpha", question="axis")
    assert [*of_axes.verdict] == ["better", "open", "open", "open"]
    where = "where minimum reward r_min is 0.5 (class r_min-0_5): "
    assert of_axes.sentence.iloc[0].startswith(f"Its WD regret is lower {where}−0.30 (")
    headline = of_alpha(lower)["worst WD regret"]
    assert (headline.verdict, headline.class_name) == ("easier", "r_min-0_5")
    assert headline.sentence.startswith(f"The WD regret of Alpha falls most {where}from 0.")


def test_larger_changes_that_are_open_are_rivals_of_the_worst(analysis):
    alpha = of_alpha(contrasted(analysis, "complexity-10", {"change": 1.06, **SINGLE}))
    worst = alpha["worst WD regret"]
    assert (worst.verdict, worst.class_name) == ("broken", "r_min-0_5")
    # Nothing is certainly the worst next to a change without an interval, however small.
    for change in (0.01, 1.06):
        alpha = of_alpha(contrasted(analysis, "complexity-10", {"change": change, **SINGLE}))
        assert alpha["certainty of WD regret"].verdict == "rivals"
        assert "complexity L" in alpha["certainty of WD regret"].sentence


def test_classes_that_differ_in_several_fields_are_rivals_of_each_other(analysis):
    fields = {"change": 1.2, "low": 1.1, "high": 1.3, "axis": SEVERAL}
    several = contrasted(contrasted(analysis, "k-25", fields), "complexity-10", fields)
    assert of_alpha(several)["certainty of WD regret"].verdict == "rivals"
    axes = rows_of(findings(several), algorithm="Alpha", question="axis")
    assert {"k-25", "complexity-10"} <= {*axes.class_name}


def test_few_pairs_make_an_indication_and_a_caveat(analysis):
    beta = found(analysis, section="tasks", algorithm="Beta")
    assert beta["worst WD regret"].verdict == "broken_few"
    assert "An indication: it rests on fewer than 5" in beta["worst WD regret"].sentence
    caveats = found(analysis, section="caveats")
    assert caveats["few runs"].runs == 3
    assert caveats["missing runs"].sentence.startswith("2 of 75 runs are missing, 1 of them")
    assert "complexity-10" in caveats["policy_init"].sentence


def test_single_runs_show_nothing(finished):
    cut = analysed(finished, lambda p: p.run > 0)
    for name in cut.learners:
        own = found(cut, section="tasks", algorithm=name)
        assert own["worst WD regret"].verdict == "none_shown"
    ends = {"change": 0.01, "low": -0.02, "high": 0.04, "pairs": 2}
    assert of_alpha(contrasted(cut, "k-25", ends))["worst WD regret"].verdict == "none_shown"


def test_a_first_class_that_was_not_learnt_is_marked(analysis):
    assert "first class" not in of_alpha(analysis)
    levels = analysis.tables["levels"].copy()
    levels.loc[(levels.class_name == "default") & (levels.metric == "wd_regret"), "iqm"] = 0.97
    unlearnt = of_alpha(with_tables(analysis, levels=levels))["first class"]
    assert (unlearnt.verdict, unlearnt.value) == ("unlearnt", 0.97)


def test_a_run_that_learnt_nothing_where_another_did_is_named(analysis):
    runs = analysis.runs.copy()
    of_cell = (runs.class_name == "default") & (runs.algorithm == "Alpha")
    runs.loc[of_cell, "wd_regret"] = [0.9, 0.4, 0.79, 0.85, 0.4]
    row = found(dataclasses.replace(analysis, runs=runs), class_name="default")["stuck runs"]
    assert (row.algorithm, row.value, row.runs) == ("Alpha", 0.85, 5)
    assert "2 runs of 5 learnt nothing (run 0 and run 3:" in row.sentence
    runs.loc[of_cell, "wd_regret"] = [0.9, 0.46, 0.79, 0.85, 0.46]  # none has half of it
    assert "stuck runs" not in found(dataclasses.replace(analysis, runs=runs), class_name="default")


@pytest.mark.parametrize(
    ("change", "verdict"), [(0.3, "broken"), (0.1, "hurt"), (0.01, "slightly_hurt")]
)
def test_severity_is_the_size_of_the_largest_change(analysis, change, verdict):
    rows = analysis.tables["contrasts"]
    rows = rows.assign(change=change, low=change / 2, high=2 * change, verdict="worse")
    assert of_alpha(with_tables(analysis, contrasts=rows))["worst WD regret"].verdict == verdict


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [((0.1, 0.9, 5), "open"), ((0.98, 1.0, 5), "above"), ((0.98, 1.0, 4), "above_few"),
     ((0.1, 0.2, 5), "below")],
)  # fmt: skip
def test_an_improvement_is_judged_by_its_interval_against_a_half(analysis, ends, verdict):
    best = found(analysis, section="comparison")["best"]
    assert best.algorithm in analysis.learners
    assert 0 <= best.low <= best.value <= best.high
    assert (best.verdict, best.runs) == ("best_few", 3)  # of Beta on k-25
    of_best = f"the lowest WD regret: {best.value:.2f} (95 % interval {best.low:.2f}"
    assert of_best in best.sentence
    rows = analysis.tables["improvements"]
    rows = rows.assign(**dict(zip(("low", "high", "fewest_runs"), ends, strict=True)))
    row = found(with_tables(analysis, improvements=rows), section="comparison")["improvement"]
    assert (row.verdict, row.runs) == (verdict, ends[2])


def test_different_training_steps_are_reported(analysis):
    assert "training steps" not in found(analysis)
    plan = scaled(analysis.file, steps_of={"Alpha": 4000})
    steps = found(dataclasses.replace(analysis, file=plan))["training steps"]
    assert steps.sentence == "Training steps differ: Alpha 4,000, Beta 40."
    for second in ("Beta", "constant"):
        of_pair = rows_of(analysis.tables["differences"], first="Alpha", second=second)
        caveats = comparison_caveats(plan.plan, of_pair)
        assert (steps.sentence in caveats) == (second == "Beta")


def text_of(analysis):
    """What a reader sees of the page."""
    text = page(analysis)
    body = re.sub("</?(code|strong)>", "", text[text.index("<main>") :])
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", body)).split())


def assert_worded(analysis):
    """The text of a page without values that are missing and without gaps between words."""
    text = text_of(analysis)
    assert not re.search(r"None|nan\b", text)
    assert not re.search(r"\(\s|\s[,.;:)]|\.\.|,,", text)
    assert not re.search(r"\d[a-z]{3}|[a-z½)](?=[0-9A-Z½])", text[: text.index("Tables")])
    return text


def test_the_page_has_the_sentences(analysis, finished):
    text = assert_worded(analysis)
    for row in findings(analysis).itertuples():
        assert " ".join(row.sentence.split()) in text
    assert "No algorithm" not in text
    nothing = analysed(finished, lambda planned: planned.algorithm != "constant")
    assert "No algorithm that learns has a finished run yet" in assert_worded(nothing)
