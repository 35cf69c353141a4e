import re
from xml.etree import ElementTree

import pytest

from leaderboard.documents.result import Estimate
from leaderboard.web.site import charts

REGRET = {"optimal": 0.0, "constant": 1.0}


@pytest.mark.parametrize(
    ("value", "text"), [(-0.0001, "0.000"), (-0.25, "\u22120.250"), (1.0, "1.000"), (0.0, "0.000")]
)
def test_a_number_has_a_true_minus_and_no_negative_zero(value, text):
    assert charts.number(value) == text


def test_a_bar_spans_its_interval_and_marks_its_value():
    estimate = Estimate(value=0.5, low=0.25, high=1.0)
    bar = ElementTree.fromstring(charts.Bars([estimate], REGRET).bar(estimate))
    interval = bar.find("line[@class='ci']")
    assert (interval.get("x1"), interval.get("x2")) == ("26.50%", "97.00%")
    assert bar.find("circle").get("cx") == "50.00%"
    assert bar.find("line[@class='optimal']").get("x1") == "3.00%"
    assert bar.find("line[@class='constant']").get("x1") == "97.00%"


def test_a_sparkline_has_its_numbers_as_text():
    (spark,) = charts.sparklines([[0.1, 0.25, 0.4]])
    assert "0.10, 0.25, 0.40" in ElementTree.fromstring(spark).get("aria-label")
    assert len(re.search(r'points="([^"]*)"', spark)[1].split()) == 3


def test_a_chart_of_many_regions_labels_only_some():
    edges = [(0.0, 0.0), *((m / 100, (m + 1) / 100) for m in range(100))]
    profile = [Estimate(value=0.1, low=0.0, high=0.2)] * len(edges)
    chart = ElementTree.fromstring(charts.regret_chart(profile, edges, "x"))
    labels = [text.text for text in chart.iter("text") if "–" in (text.text or "")]
    assert 5 <= len(labels) <= 12
    assert len(list(chart.iter("circle"))) == len(edges)


def test_a_chart_has_a_title_and_a_description_and_escapes_the_name():
    profile = [Estimate(value=0.1, low=0.0, high=0.2)] * 2
    chart = charts.regret_chart(profile, [(0, 0), (0, 1)], "<b>&\"'")
    drawn = ElementTree.fromstring(chart)
    assert drawn.get("aria-labelledby") == "chart-title chart-desc"
    assert drawn.find("title").text == "Normalised regret of <b>&\"' by region"
    assert "WD: 0.100, from 0.000 to 0.200" in drawn.find("desc").text
