"""What the pages of results say is what their scripts find, in committed rows or on less."""

import importlib
import re
import sys
from pathlib import Path

import pytest

from sme_registry import Profile, load, materialize

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(RESULTS)

    def imported(name):
        sys.modules.pop(name, None)
        return importlib.import_module(name)

    return imported


def test_a_plan_without_cost_beats_the_safe_projection_but_not_where_its_price_is_paid(
    script, monkeypatch
):
    plans = script("safe_plans")
    monkeypatch.setattr(plans, "EPISODES", 2)
    monkeypatch.setattr(plans, "SEQUENCES", 64)
    for name, gain in (("Safety40", 5.0), ("CompensatedSafety40", 0.0)):
        task = materialize(load(name).derive(horizon=40))
        earned, cost = plans.planned(task, 0)
        assert (cost == 0.0).all()
        assert earned.mean() >= plans.projected(task, 0).mean() + gain - 1e-9
        if task.spec.compensated:
            assert earned.max() <= 40.0 + 1e-9


def test_the_parts_of_a_reference_profile_are_joined_to_the_whole(script):
    whole = Profile.references()["PPO"]
    parts = [whole.model_copy(update={"rows": rows}) for rows in (whole.rows[40:], whole.rows[:50])]
    assert set(script("profiles").joined(parts).rows) == set(whole.rows)


TABLES = {  # the parts of pages whose tables and intervals the committed rows give
    "ablations": [("## PPO, ten runs", "- **Missing")],
    "decay": [("| 100,000 steps", "The paper reports"), ("| | cosine", "It is no evidence")],
    "foresight": [("| misleading − control", "- **On the plain"), ("## Noise", "## What is miss")],
    "continual": [("| | | N at visits", "![Plasticity"), ("| N on the visit's", "From visit 2 on")],
    "agents": [
        ("## Environments", "At L = 50"),
        ("## Training", "- An SB3 agent"),
        ("JAX minus SB3 in N₀", "Three runs of TD3"),
        ("Stable-Baselines3's agents, ten", "On the plane"),
    ],
    "offline": [("## Quality of the data", "## Ours and d3rlpy's")],
    "limits_and_distractors": [("## Which distractors", "![Step reward against cost")],
}
WHOLE = "ablations", "decay", "foresight", "continual"  # where all other numbers, too, are theirs


@pytest.mark.parametrize("page", TABLES)
def test_the_numbers_of_a_page_are_those_of_the_committed_rows(page, script):
    pytest.importorskip("pandas")
    text = (RESULTS / f"{page}.md").read_text(encoding="utf-8").replace("−", "-")
    output = script("summary").printed(page)
    found = {float(number) for number in re.findall(r"-?\d+\.\d+", output)}
    n = r"(-?\d+\.\d+)"
    neighbours = as_numbers(re.findall(rf"(?={n} +{n} +{n})", output))
    for begin, end in TABLES[page]:
        begin, end = begin.replace("−", "-"), end.replace("−", "-")
        section = text[text.index(begin) : text.index(end)]
        tables = "\n".join(re.findall(r"^\|.*", section, re.M))
        told = re.findall(r"-?\d+\.\d\d+", re.sub(r"= [\d., ]+", "", tables))
        assert len(told) > 5
        assert {float(number) for number in told} <= found
        # A value and its interval, or its range, are neighbours there, too, also of a sentence.
        intervals = re.findall(rf"{n} [(\[]{n}(?:,| to) {n}[)\]]", section)
        assert as_numbers(intervals) <= neighbours
    if page in WHOLE:
        prose = re.sub(r"```.*?```|\[[^]]*\]\([^)]*\)", "", text, flags=re.S)
        told = re.findall(r"(?<![\d.])\d+\.\d\d+(?!\d|\.\d)", prose)
        assert {float(number) for number in told} <= {abs(number) for number in found}


def as_numbers(rows):
    return {tuple(map(float, row)) for row in rows}


def test_the_rows_of_lives_are_of_as_many_lives_as_the_page_says():
    pandas = pytest.importorskip("pandas")
    for name, per_life in (("lives", 2), ("lives-visits", 5)):  # two regions; of Cycle2 six visits
        rows = pandas.read_csv(RESULTS / "continual" / f"{name}.csv")
        lives = rows.groupby(["class_name", "algorithm"])["run"].agg(["nunique", "size"])
        for (stream, algorithm), row in lives.iterrows():
            assert row["nunique"] == {"PPO": 5, "TD3": 3, "SAC": 3}[algorithm]
            longer = name == "lives-visits" and stream == "Cycle2"
            assert row["size"] == row["nunique"] * (per_life + longer)
        assert len(lives) == 9
