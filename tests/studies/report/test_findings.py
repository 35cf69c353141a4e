"""Findings of a study: verdicts that the tables support, each with words on the page."""

import dataclasses
import html
import itertools
import math
import re
from typing import get_args

import pytest

from sme_registry.studies.report.findings import (
    AlgorithmFinding,
    Contrast,
    OutOfDistribution,
    Rival,
    findings,
)
from sme_registry.studies.report.tables import ENOUGH_RUNS, contrast_verdict
from tests.studies.finished import analysed

pytest.importorskip("matplotlib")

from sme_registry.studies.report.page import page

CHANGE = Contrast(
    class_name="c", axis="k", setting="k = 25", base=0.1, level=0.9, change=0.8, low=0.7,
    high=0.9, pairs=5, enough_pairs=True, verdict="worse",
)  # fmt: skip
SINGLE = {"low": math.nan, "high": math.nan, "pairs": 1}


def contrasted(analysis, class_name, fields):
    """With another contrast of Alpha's regret within the distribution."""
    rows = analysis.contrasts.copy()
    at = rows[["class_name", "algorithm", "metric"]] == [class_name, "Alpha", "wd_regret"]
    for name, value in fields.items():
        rows.loc[at.all(axis=1), name] = value
    rows["enough_pairs"] = rows.pairs >= ENOUGH_RUNS
    rows["verdict"] = [contrast_verdict(r.change, r.low, r.high) for r in rows.itertuples()]
    return dataclasses.replace(analysis, contrasts=rows)


def of_alpha(analysis):
    return findings(analysis).algorithms[0]


def classes(contrasts):
    return [contrast.class_name for contrast in contrasts]


def worst_class(finding):
    return finding.worst.class_name


def test_findings_name_the_property_that_each_learner_was_built_to_fail_at(analysis):
    alpha, beta = findings(analysis).algorithms
    assert (alpha.algorithm, alpha.verdict, worst_class(alpha)) == ("Alpha", "broken", "r_min-0_5")
    assert alpha.worst.pairs == 5
    assert (alpha.certainty, alpha.larger) == ("certain", ())
    assert (beta.algorithm, beta.verdict, worst_class(beta)) == ("Beta", "broken", "k-25")


def test_larger_changes_that_are_open_are_listed_next_to_the_worst(analysis):
    alpha = of_alpha(contrasted(analysis, "complexity-10", {"change": 1.06, **SINGLE}))
    assert (alpha.verdict, worst_class(alpha)) == ("broken", "r_min-0_5")
    assert classes(alpha.larger) == ["complexity-10"]
    assert (alpha.larger[0].change, alpha.larger[0].low) == (1.06, None)
    assert alpha.certainty == "rivals"
    assert "complexity-10" not in classes(alpha.open)
    # Nothing is certainly the worst next to a change without an interval, however small.
    alpha = of_alpha(contrasted(analysis, "complexity-10", {"change": 0.01, **SINGLE}))
    assert (alpha.certainty, classes(alpha.rivals)) == ("rivals", ["complexity-10"])


def test_few_pairs_make_an_indication_and_a_caveat(analysis):
    found = findings(analysis)
    assert found.algorithms[1].certainty == "indication"
    assert found.caveats.fewest_pairs == 3
    assert (found.caveats.missing, found.caveats.planned) == (2, 75)
    assert found.caveats.other_policy_init == ("complexity-10",)


def test_single_runs_show_nothing(finished):
    cut = analysed(finished, lambda p: p.run > 0)
    for finding in findings(cut).algorithms:
        assert finding.verdict == "none_shown"
        rows = cut.contrasts
        rows = rows[(rows.algorithm == finding.algorithm) & (rows.metric == "wd_regret")]
        assert finding.largest_single.change == rows.change.max()
        assert finding.highest_change is None
    ends = {"change": 0.01, "low": -0.02, "high": 0.04, "pairs": 2}
    alpha = of_alpha(contrasted(cut, "k-25", ends))
    assert (alpha.verdict, alpha.highest_change) == ("none_shown", 0.04)
    assert alpha.largest_single.class_name != "k-25"


def test_a_first_class_that_was_not_learnt_is_marked(analysis):
    assert not any(finding.base_unlearnt for finding in findings(analysis).algorithms)
    levels = analysis.levels.copy()
    levels.loc[(levels.class_name == "default") & (levels.metric == "wd_regret"), "iqm"] = 0.97
    for finding in findings(dataclasses.replace(analysis, levels=levels)).algorithms:
        assert finding.base_unlearnt
        assert finding.base_wd_regret == 0.97


def test_an_improvement_whose_interval_includes_a_half_is_open(analysis):
    (best,) = findings(analysis).best
    assert best.algorithm in analysis.learners
    blurred = analysis.improvements.assign(low=0.1, high=0.9)
    (best,) = findings(dataclasses.replace(analysis, improvements=blurred)).best
    assert [rival.verdict for rival in best.rivals] == ["open"]
    certain = analysis.improvements.assign(probability=0.99, low=0.98, high=1.0)
    certain[["first", "second"]] = [
        (best.algorithm, row.second if row.first == best.algorithm else row.first)
        for row in certain.itertuples()
    ]
    (best,) = findings(dataclasses.replace(analysis, improvements=certain)).best
    assert "open" not in [rival.verdict for rival in best.rivals]


def test_different_training_steps_are_reported(analysis):
    assert findings(analysis).steps == {}
    runs = analysis.runs.copy()
    runs.loc[runs.algorithm == "Alpha", "steps"] = 4000
    steps = findings(dataclasses.replace(analysis, runs=runs)).steps
    assert steps == {"Alpha": 4000, "Beta": 40}


def choices(model, field):
    """The values of a field that is an enumeration, and None where it may be that."""
    annotation = model.model_fields[field].annotation
    values = itertools.chain(*(get_args(part) or (part,) for part in get_args(annotation)))
    return tuple(None if value is type(None) else value for value in values)


def every_algorithm_finding():
    """Every verdict with every certainty and position, and lists with and without entries."""
    worst = CHANGE
    single = {"axis": "", "low": None, "high": None, "pairs": 1, "enough_pairs": False}
    few = {"axis": "several axes", "pairs": 3, "enough_pairs": False}
    listed = (worst, worst.model_copy(update=single), worst.model_copy(update=few))
    found = [AlgorithmFinding(algorithm="A", verdict="no_contrasts")]
    for better, highest, largest in itertools.product(((), listed), (None, 0.1), (None, worst)):
        nothing = {"better": better, "highest_change": highest, "largest_single": largest}
        found.append(AlgorithmFinding(algorithm="A", verdict="none_shown", **nothing))
    for verdict, certainty, position, contrasts in itertools.product(
        ("broken", "hurt", "slightly_hurt"),
        [value for value in choices(AlgorithmFinding, "certainty") if value],
        choices(AlgorithmFinding, "position"),
        ((), listed),
    ):
        found.append(
            AlgorithmFinding(
                algorithm="A", verdict=verdict, base_wd_regret=0.95, base_unlearnt=bool(contrasts),
                worst=worst, larger=contrasts, certainty=certainty, rivals=listed,
                position=position, linear_wd_regret=0.5, base_linear_wd_regret=0.2,
                harder_to_fit=bool(contrasts), also_worse=contrasts, open=contrasts,
                out_of_distribution=OutOfDistribution(worst=worst, larger=contrasts)
                if contrasts or certainty == "rivals" else None,
            )
        )  # fmt: skip
    return found


def text_of(analysis, found, *reasons):
    """What a reader sees of the page."""
    text = page(analysis, found, [], reasons, [])
    body = re.sub("</?(code|strong)>", "", text[text.index("<main>") :])
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", body)).split())


def assert_worded(analysis, found):
    """The text of a page without values that are missing and without gaps between words."""
    text = text_of(analysis, found, "No maps.")
    assert "None" not in text
    assert not re.search(r"\(\s|\s[,.;:)]|\.\.|,,", text)
    assert not re.search(r"\d[a-z]{3}|[a-z½)](?=[0-9A-Z½])", text[: text.index("Tables")])
    return text


def test_every_verdict_has_words_on_the_page(analysis):
    found = findings(analysis)
    rivals = tuple(
        Rival(algorithm="B", probability=0.6, low=low, high=low, verdict=verdict)
        for verdict in choices(Rival, "verdict")
        for low in (None, 0.4)
    )
    (best,) = found.best
    many = best.model_copy(update={"rivals": rivals, "nu": 0.5, "transitions": 50_000})
    none = {"missing": 0, "fewest_pairs": None, "intervals": 0, "other_policy_init": ()}
    everything = {
        "algorithms": tuple(every_algorithm_finding()),
        "best": (best, many),
        "steps": {"A": 40, "B": 4000},
        "caveats": found.caveats.model_copy(update={"failed": 1}),
    }
    assert_worded(analysis, found.model_copy(update=everything))
    nothing = {"algorithms": (), "caveats": found.caveats.model_copy(update=none)}
    assert "No algorithm" in assert_worded(analysis, found.model_copy(update=nothing))
