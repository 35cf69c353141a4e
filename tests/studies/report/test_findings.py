"""Findings of a study: verdicts that the tables support, each with words on the page."""

from __future__ import annotations

import dataclasses
import html
import itertools
import math
import re
from pathlib import Path
from typing import Any, get_args

import pytest

from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.findings import (
    AlgorithmFinding,
    Contrast,
    Findings,
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


def contrasted(analysis: Analysis, *changes: tuple[str, str, dict[str, Any]]) -> Analysis:
    """With other contrasts of Alpha, each by its class and metric."""
    rows = analysis.contrasts.copy()
    for class_name, metric, fields in changes:
        at = (rows.class_name == class_name) & (rows.algorithm == "Alpha") & (rows.metric == metric)
        for name, value in fields.items():
            rows.loc[at, name] = value
    rows["enough_pairs"] = rows.pairs >= ENOUGH_RUNS
    rows["verdict"] = [contrast_verdict(r.change, r.low, r.high) for r in rows.itertuples()]
    return dataclasses.replace(analysis, contrasts=rows)


def of_alpha(analysis: Analysis) -> AlgorithmFinding:
    return findings(analysis).algorithms[0]


def classes(contrasts: Any) -> list[str]:
    return [contrast.class_name for contrast in contrasts]


def worst_class(finding: AlgorithmFinding | OutOfDistribution) -> str:
    assert finding.worst is not None
    return finding.worst.class_name


def test_findings_name_the_property_that_each_learner_was_built_to_fail_at(analysis: Analysis):
    alpha, beta = findings(analysis).algorithms
    assert (alpha.algorithm, alpha.verdict, worst_class(alpha)) == ("Alpha", "broken", "r_min-0_5")
    assert alpha.worst is not None
    assert alpha.worst.pairs == 5
    assert (alpha.certainty, alpha.larger) == ("certain", ())
    assert (beta.algorithm, beta.verdict, worst_class(beta)) == ("Beta", "broken", "k-25")


def test_larger_changes_that_are_open_are_listed_next_to_the_worst(analysis: Analysis):
    changes = (
        ("complexity-10", "wd_regret", {"change": 1.06, **SINGLE}),
        ("complexity-10", "ood_regret", {"change": 1.01, **SINGLE}),
    )
    alpha = of_alpha(contrasted(analysis, *changes))
    assert (alpha.verdict, worst_class(alpha)) == ("broken", "r_min-0_5")
    assert classes(alpha.larger) == ["complexity-10"]
    assert (alpha.larger[0].change, alpha.larger[0].low) == (1.06, None)
    assert alpha.certainty == "rivals"
    assert "complexity-10" not in classes(alpha.open)
    outside = alpha.out_of_distribution
    assert outside is not None
    assert worst_class(outside) == "r_min-0_5"
    assert [contrast.change for contrast in outside.larger] == [1.01]
    # Nothing is certainly the worst next to a change without an interval, however small.
    small = ("complexity-10", "wd_regret", {"change": 0.01, **SINGLE})
    alpha = of_alpha(contrasted(analysis, small))
    assert (alpha.certainty, classes(alpha.rivals)) == ("rivals", ["complexity-10"])


def test_an_axis_with_one_change_for_the_worse_still_lists_an_open_one(analysis: Analysis):
    changes = (
        ("k-25", "wd_regret", {"change": 0.05, "low": 0.02, "high": 0.08}),
        ("complexity-10", "wd_regret", {"axis": "k", "change": 0.1, **SINGLE}),
    )
    alpha = of_alpha(contrasted(analysis, *changes))
    (contrast,) = (contrast for contrast in alpha.open if contrast.axis == "k")
    assert (contrast.class_name, contrast.change, contrast.pairs) == ("complexity-10", 0.1, 1)


@pytest.mark.parametrize(
    ("level", "position"),
    [
        (0.1, "better_than_linear"),
        (0.5, "worse_than_linear"),
        (0.95, "like_constant"),
        (1.25, "worse_than_constant"),
    ],
)
def test_the_position_of_a_broken_policy_is_among_the_references(
    analysis: Analysis, level: float, position: str
):
    alpha = of_alpha(contrasted(analysis, ("r_min-0_5", "wd_regret", {"level": level})))
    assert alpha.position == position


def test_few_pairs_make_an_indication_and_a_caveat(analysis: Analysis):
    found = findings(analysis)
    assert found.algorithms[1].certainty == "indication"
    assert found.caveats.fewest_pairs == 3
    assert (found.caveats.missing, found.caveats.planned) == (2, 75)
    assert found.caveats.other_policy_init == ("complexity-10",)


def test_a_slight_change_is_not_called_broken(finished: Path):
    """Without r_min, nothing that is left makes more than a slight difference to Alpha."""
    cut = analysed(finished, lambda p: (p.class_name, p.algorithm) == ("r_min-0_5", "Alpha"))
    alpha = of_alpha(cut)
    assert alpha.verdict in ("slightly_hurt", "none_shown") or alpha.certainty == "rivals"
    assert alpha.verdict != "broken"


def test_single_runs_show_nothing(finished: Path):
    cut = analysed(finished, lambda p: p.run > 0)
    for finding in findings(cut).algorithms:
        assert finding.verdict == "none_shown"
        rows = cut.contrasts
        rows = rows[(rows.algorithm == finding.algorithm) & (rows.metric == "wd_regret")]
        assert finding.largest_single is not None
        assert finding.largest_single.change == rows.change.max()
        assert finding.highest_change is None
    ends = {"change": 0.01, "low": -0.02, "high": 0.04, "pairs": 2}
    alpha = of_alpha(contrasted(cut, ("k-25", "wd_regret", ends)))
    assert (alpha.verdict, alpha.highest_change) == ("none_shown", 0.04)
    assert alpha.largest_single is not None
    assert alpha.largest_single.class_name != "k-25"


def test_without_the_first_class_there_are_no_contrasts(finished: Path):
    cut = analysed(finished, lambda p: p.class_name == "default")
    assert {finding.verdict for finding in findings(cut).algorithms} == {"no_contrasts"}


def test_a_first_class_that_was_not_learnt_is_marked(analysis: Analysis):
    assert not any(finding.base_unlearnt for finding in findings(analysis).algorithms)
    levels = analysis.levels.copy()
    levels.loc[(levels.class_name == "default") & (levels.metric == "wd_regret"), "iqm"] = 0.97
    for finding in findings(dataclasses.replace(analysis, levels=levels)).algorithms:
        assert finding.base_unlearnt
        assert finding.base_wd_regret == 0.97


def test_an_improvement_whose_interval_includes_a_half_is_open(analysis: Analysis):
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


def test_different_training_steps_are_reported(analysis: Analysis):
    assert findings(analysis).steps == {}
    runs = analysis.runs.copy()
    runs.loc[runs.algorithm == "Alpha", "steps"] = 4000
    steps = findings(dataclasses.replace(analysis, runs=runs)).steps
    assert steps == {"Alpha": 4000, "Beta": 40}


def choices(model: Any, field: str) -> tuple[Any, ...]:
    """The values of a field that is an enumeration, and None where it may be that."""
    annotation = model.model_fields[field].annotation
    values = itertools.chain(*(get_args(part) or (part,) for part in get_args(annotation)))
    return tuple(None if value is type(None) else value for value in values)


def every_algorithm_finding(analysis: Analysis) -> list[AlgorithmFinding]:
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


def text_of(analysis: Analysis, found: Findings, *reasons: str) -> str:
    """What a reader sees of the page."""
    text = page(analysis, found, [], reasons, [])
    body = re.sub("</?(code|strong)>", "", text[text.index("<main>") :])
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", body)).split())


def assert_worded(analysis: Analysis, found: Findings) -> str:
    """The text of a page without values that are missing and without gaps between words."""
    text = text_of(analysis, found, "No maps.")
    assert "None" not in text
    assert not re.search(r"\(\s|\s[,.;:)]|\.\.|,,", text)
    assert not re.search(r"\d[a-z]{3}|[a-z½)](?=[0-9A-Z½])", text[: text.index("Tables")])
    return text


def test_every_verdict_has_words_on_the_page(analysis: Analysis):
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
        "algorithms": tuple(every_algorithm_finding(analysis)),
        "best": (best, many),
        "steps": {"A": 40, "B": 4000},
        "caveats": found.caveats.model_copy(update={"failed": 1}),
    }
    assert_worded(analysis, found.model_copy(update=everything))
    nothing = {"algorithms": (), "caveats": found.caveats.model_copy(update=none)}
    assert "No algorithm" in assert_worded(analysis, found.model_copy(update=nothing))


def in_words(analysis: Analysis, **fields: Any) -> str:
    """What the page says of one algorithm, A."""
    finding = AlgorithmFinding(algorithm="A", **fields)
    found = findings(analysis).model_copy(update={"algorithms": (finding,)})
    return text_of(analysis, found)


def test_headlines_name_the_most_important_first(analysis: Analysis) -> None:
    hurt = {"verdict": "slightly_hurt", "base_wd_regret": 0.95, "worst": CHANGE}
    words = "A is hurt slightly, most by reward interval k: on c its WD regret"
    assert words in in_words(analysis, **hurt)
    text = in_words(analysis, **hurt, base_unlearnt=True)
    assert "A has learnt almost nothing" in text
    assert "A is hurt" not in text
    better = CHANGE.model_copy(update={"change": -0.03, "verdict": "better"})
    text = in_words(analysis, verdict="none_shown", better=(better,))
    assert "Other classes are easier for A than the first one, default:" in text
    assert "No class was shown to make" not in text
