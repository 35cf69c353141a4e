from __future__ import annotations

import csv
import io
import json
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.result import Estimate, Scores
from leaderboard.errors import NotPublishable
from leaderboard.exports import to_csv, to_json, to_latex
from leaderboard.scoring.ranking import (
    ranking,
    refuse_unpublishable,
    superseded,
)
from leaderboard.store import EntryRow, Likeness
from sme_registry import EvaluationProtocol
from sme_registry.spec import Suite

BOARD = BoardDocument(
    title="Small",
    suite_name="small_suite-v1",
    suite=Suite.from_dict(
        {"classes": [{"name": "a", "setting": {"state_dim": 2, "action_dim": 1}, "seeds": [0]}]}
    ),
    protocol_name="few-v1",
    protocol=EvaluationProtocol(states_per_region=60),
    key=SigningKey.generate().public,
)
HEAD = (7, "sha256:" + "ab" * 32)
DATE = "2026-11-21T09:30:00Z"


def scores(wd: float, ood: float, arm: float = 0.05) -> Scores:
    def around(value: float, arm: float = arm) -> Estimate:
        return Estimate(value=value, low=value - arm, high=value + arm)

    return Scores(
        wd_regret=around(wd),
        ood_regret=around(ood),
        ood_decay=around(ood - wd),
        regret_slope=around(0.0),
        similarity_loss=around(1.0),
        normalised_regret=(around(wd), *(around(ood) for _ in range(5))),
    )


def entry(sequence: int, values: Scores | None = None, **fields: Any) -> EntryRow:
    return replace(
        EntryRow(
            id=f"sha256:{sequence:064x}",
            sequence=sequence,
            received=DATE,
            status="scored",
            code="",
            method=f"method {sequence}",
            version="1",
            family="PPO",
            knowledge="generic",
            submitter="somebody",
            key="0" * 64,
            code_link=None,
            runs=60,
            steps=10**6,
            enough_runs=True,
            oracle_like=False,
            reference=False,
            scores=values,
        ),
        **fields,
    )


def reference(sequence: int, name: str, regret: float, **fields: Any) -> EntryRow:
    values = scores(regret, regret, arm=0.0)
    return entry(sequence, values, method=name, reference=True, enough_runs=False, **fields)


REFERENCES = [reference(1, "optimal", 0.0), reference(2, "constant", 1.0)]


def test_entries_are_ordered_with_the_ranks_that_their_intervals_allow() -> None:
    entries = [
        entry(3, scores(0.50, 0.6)),
        entry(4, scores(0.20, 0.6)),
        entry(5, scores(0.25, 0.6)),
        entry(6, scores(0.80, 0.9)),
    ]

    rows = ranking(entries, "wd_regret")

    assert [(row.entry.sequence, row.first, row.last) for row in rows] == [
        (4, 1, 2),
        (5, 1, 2),
        (3, 3, 3),
        (6, 4, 4),
    ]
    assert {row.reason for row in rows} == {""}


def test_each_metric_has_its_own_order() -> None:
    entries = [entry(3, scores(0.1, 0.9)), entry(4, scores(0.3, 0.5)), entry(5, scores(0.4, 0.45))]

    orders = {
        metric: [row.entry.sequence for row in ranking(entries, metric)]
        for metric in ("wd_regret", "ood_regret", "ood_decay")
    }

    assert orders == {"wd_regret": [3, 4, 5], "ood_regret": [5, 4, 3], "ood_decay": [5, 4, 3]}


def test_equal_scores_are_in_order_of_submission() -> None:
    entries = [entry(sequence, scores(0.3, 0.4)) for sequence in (9, 4, 7)]

    assert [row.entry.sequence for row in ranking(entries, "wd_regret")] == [4, 7, 9]


def test_unranked_entries_have_a_reason_and_take_no_rank() -> None:
    entries = [
        *REFERENCES,
        entry(3, scores(0.1, 0.2), enough_runs=False),
        entry(4, scores(0.3, 0.4)),
    ]

    rows = ranking(entries, "wd_regret")

    assert [(row.entry.sequence, row.first, row.last, row.reason) for row in rows] == [
        (1, None, None, "reference"),
        (3, None, None, "too_few_runs"),
        (4, 1, 1, ""),
        (2, None, None, "reference"),
    ]


def test_entries_that_may_not_have_learned_have_no_rank_by_ood_decay() -> None:
    unsure, sure = entry(3, scores(0.46, 0.46)), entry(4, scores(0.45, 0.6))

    rows = ranking([unsure, sure], "ood_decay")

    assert [(row.entry.sequence, row.first, row.reason) for row in rows] == [
        (3, None, "not_learned"),
        (4, 1, ""),
    ]
    assert [row.first for row in ranking([unsure, sure], "wd_regret")] == [1, 1]


# By decay, sabotage inside the cube wins nothing


def by_decay(*entries: EntryRow) -> list[tuple[int, int | None, int | None]]:
    rows = ranking(list(entries), "ood_decay")
    return [(row.entry.sequence, row.first, row.last) for row in rows]


def test_a_policy_made_worse_inside_the_cube_stays_below_the_original() -> None:
    original = entry(3, scores(0.1, 0.3, 0.01))
    sabotaged = entry(4, scores(0.44, 0.3, 0.01))  # decay −0.14

    assert by_decay(original, sabotaged) == [(3, 1, 2), (4, 1, 2)]
    row = ranking([original, sabotaged], "ood_decay")[1]
    assert (row.value.value, row.value.low) == pytest.approx((0.2, 0.19))
    assert sabotaged.scores is not None
    assert sabotaged.scores.ood_decay.value == pytest.approx(-0.14)  # as scored


def test_a_sabotaged_policy_does_not_win_by_luck_in_the_states_of_some_regions() -> None:
    original = entry(3, scores(0.1, 0.3, 0.01))
    sabotaged = entry(4, scores(0.44, 0.299, 0.01))

    assert by_decay(original, sabotaged) == [(3, 1, 2), (4, 1, 2)]


def test_a_decay_below_zero_is_worth_no_more_than_none() -> None:
    negative, flat = entry(3, scores(0.3, 0.2, 0.01)), entry(4, scores(0.15, 0.15, 0.01))
    optimal = entry(5, scores(0.0, 0.0, 0.0))

    assert by_decay(negative, flat, optimal) == [(5, 1, 3), (4, 1, 3), (3, 1, 3)]


def test_an_entry_without_a_rank_holds_nobody_down() -> None:
    better = entry(3, scores(0.1, 0.3, 0.01), enough_runs=False)
    worse, other = entry(4, scores(0.4, 0.35, 0.01)), entry(5, scores(0.1, 0.2, 0.01))

    assert by_decay(better, worse) == [(4, 1, 1), (3, None, None)]
    assert by_decay(better, worse, other) == [(5, 1, 2), (4, 1, 2), (3, None, None)]


def test_an_honest_entry_that_is_better_outside_keeps_its_decay() -> None:
    steep = entry(3, scores(0.1, 0.4, 0.01))
    flat = entry(4, scores(0.2, 0.3, 0.01))  # better in every outer region

    assert by_decay(steep, flat) == [(4, 1, 1), (3, 2, 2)]


def test_no_entry_stands_above_one_that_is_better_in_every_region() -> None:
    rng = random.Random(1)
    entries = [entry(i, scores(rng.random() / 3, rng.random(), 0.01)) for i in range(3, 200)]

    rows = ranking(entries, "ood_decay")

    regrets = np.array([[e.value for e in row.entry.scores.normalised_regret] for row in rows])
    for i, row in enumerate(rows):
        better = (regrets <= regrets[i]).all(axis=1) & (regrets < regrets[i]).any(axis=1)
        assert better[i:].sum() == 0
        for j in np.flatnonzero(better):
            assert (rows[j].first, rows[j].last) <= (row.first, row.last)


# One row of a key's method, and none for copies


def test_the_latest_entry_of_a_key_with_the_same_method_and_version_is_ranked() -> None:
    first = entry(3, scores(0.1, 0.2), method="PPO", version="1")
    again = entry(4, scores(0.2, 0.3), method="pp0", version="1")
    other_version = entry(5, scores(0.3, 0.3), method="PPO", version="2")
    other_key = entry(6, scores(0.4, 0.3), method="PPO", version="1", key="1" * 64)
    entries = [first, again, other_version, other_key]

    assert reasons(*entries) == {3: "superseded", 4: "", 5: "", 6: ""}
    withdrawn = replace(again, status="withdrawn")
    assert reasons(first, withdrawn, other_version, other_key) == {3: "", 5: "", 6: ""}
    few = replace(again, enough_runs=False)
    assert reasons(first, few) == {3: "", 4: "too_few_runs"}
    assert first.id not in superseded([other_version, first])


@pytest.mark.parametrize(("one", "other"), [("1.0", "10"), ("1", "2"), ("1.2", "1.3")])
def test_versions_that_differ_are_versions(one: str, other: str) -> None:
    entries = [
        entry(i, scores(0.1, 0.2), method="A", version=v) for i, v in enumerate((one, other))
    ]

    assert set(reasons(*entries).values()) == {""}


def test_twenty_versions_of_the_same_policies_are_one_row() -> None:
    first = entry(3, scores(0.1, 0.2), policies=10)
    others = [
        entry(i, scores(0.1, 0.2), policies=10, alike=(Likeness(first.id, first.key, 10),))
        for i in range(4, 23)
    ]

    found = reasons(first, *others)

    assert found == {**dict.fromkeys(range(3, 22), "superseded"), 22: ""}


def test_a_copy_of_another_key_has_no_rank_and_pushes_nobody_down() -> None:
    original = entry(3, scores(0.2, 0.3), policies=10)
    own = entry(5, scores(0.4, 0.5), key="2" * 64, policies=10)

    def thief(copied: int) -> EntryRow:
        alike = (Likeness(original.id, original.key, copied),)
        return entry(4, scores(0.1, 0.2), key="1" * 64, policies=10, alike=alike)

    assert reasons(original, thief(5), own) == {3: "", 4: "copy", 5: ""}
    assert reasons(original, thief(4), own) == {3: "", 4: "", 5: ""}
    assert thief(4).copied_runs == 4
    rows = {row.entry.sequence: row for row in ranking([original, thief(10), own], "wd_regret")}
    assert (rows[3].first, rows[5].first) == (1, 2)


def test_runs_taken_from_several_entries_count_together() -> None:
    entries = [entry(i, scores(0.2, 0.3), key=str(i) * 64, policies=10) for i in (3, 4)]
    alike = tuple(Likeness(each.id, each.key, 3) for each in entries)
    mixed = entry(5, scores(0.1, 0.2), key="5" * 64, policies=10, alike=alike)

    assert reasons(*entries, mixed)[5] == "copy"


def test_a_copy_supersedes_no_entry_of_its_key() -> None:
    stolen = (Likeness("sha256:" + "e" * 64, "9" * 64, 10),)
    own = entry(3, scores(0.2, 0.3), method="A")
    copy = entry(4, scores(0.1, 0.2), method="A", policies=10, alike=stolen)

    assert reasons(own, copy) == {3: "", 4: "copy"}


def reasons(*entries: EntryRow) -> dict[int, str]:
    return {row.entry.sequence: row.reason for row in ranking(list(entries), "wd_regret")}


def test_only_scored_entries_are_listed() -> None:
    entries = [
        entry(3, status="waiting"),
        entry(4, status="rejected", code="schema"),
        entry(5, scores(0.1, 0.2), status="withdrawn"),
    ]

    assert ranking(entries, "wd_regret") == []


# The reference rows


def test_a_board_with_right_reference_rows_is_publishable() -> None:
    nearly = [reference(1, "optimal", 9e-7), reference(2, "constant", 1 - 9e-7)]

    refuse_unpublishable(REFERENCES)
    refuse_unpublishable(nearly)


def test_a_reference_row_that_was_off_may_be_withdrawn_and_submitted_again() -> None:
    off = reference(3, "optimal", 0.1)

    with pytest.raises(NotPublishable):
        refuse_unpublishable([*REFERENCES, off])
    refuse_unpublishable([*REFERENCES, replace(off, status="withdrawn")])


@pytest.mark.parametrize("left", [0, 1])
def test_without_both_reference_rows_nothing_is_published(left: int) -> None:
    with pytest.raises(NotPublishable, match="missing: must be scored"):
        refuse_unpublishable([REFERENCES[left], entry(3, scores(0.1, 0.2))])


def test_a_submission_named_optimal_is_not_a_reference_row() -> None:
    impostor = replace(REFERENCES[0], reference=False)

    with pytest.raises(NotPublishable, match="'optimal': missing"):
        refuse_unpublishable([impostor, REFERENCES[1]])


@pytest.mark.parametrize("status", ["waiting", "rejected", "withdrawn"])
def test_a_reference_row_that_is_not_scored_blocks_publication(status: Any) -> None:
    with pytest.raises(NotPublishable, match=f"{status}: must be scored"):
        refuse_unpublishable([REFERENCES[0], replace(REFERENCES[1], status=status)])


@pytest.mark.parametrize("name", ["wd_regret", "ood_regret", "ood_decay", "regret_slope", 0, 3, 5])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("off", [2e-6, -2e-6])
def test_a_wrong_reference_row_blocks_publication_in_any_region_or_metric(
    which: int, name: str | int, off: float
) -> None:
    rows = list(REFERENCES)
    values = rows[which].scores
    assert values is not None
    if isinstance(name, int):
        profile = list(values.normalised_regret)
        profile[name] = moved(profile[name], off)
        changed = values.model_copy(update={"normalised_regret": tuple(profile)})
    else:
        changed = values.model_copy(update={name: moved(getattr(values, name), off)})
    rows[which] = replace(rows[which], scores=changed)

    with pytest.raises(NotPublishable, match=f"{rows[which].method}.*{name}="):
        refuse_unpublishable(rows)


def moved(estimate: Estimate, off: float) -> Estimate:
    return estimate.model_copy(update={"value": estimate.value + off})


def test_the_constant_policy_may_lose_points_outside() -> None:
    values = REFERENCES[1].scores
    assert values is not None
    points = Estimate(value=2.2, low=2.0, high=2.4)
    row = replace(REFERENCES[1], scores=values.model_copy(update={"similarity_loss": points}))

    refuse_unpublishable([REFERENCES[0], row])


# As files

HOSTILE = '=HYPERLINK("http://x","y")'


def hostile_rows() -> list[Any]:
    evil = entry(3, scores(0.3, 0.2), method=HOSTILE, submitter="a;=1+1\r\n=2", version="-1")
    tex = entry(4, scores(0.6, 0.7), method=r"\input{/etc/passwd} 50% & $x_1^2$ #~", version="+1")
    return ranking([*REFERENCES, evil, tex], "wd_regret")


def test_no_cell_of_the_csv_is_a_formula() -> None:
    text = to_csv(hostile_rows(), "wd_regret", BOARD, HEAD, DATE)
    lines = list(csv.DictReader(io.StringIO(text)))

    assert len(lines) == 4
    for line in lines:
        for name, cell in line.items():
            try:
                float(cell)
            except ValueError:
                assert not cell.startswith(("=", "+", "-", "@", "\t", "\r")), (name, cell)
    assert lines[1]["method"] == "'" + HOSTILE
    assert '"a;=1+1 =2"' in text  # whole in its quotes, where semicolons split cells, too


def test_text_that_looks_like_a_negative_number_stays_text_in_the_csv() -> None:
    lines = list(
        csv.DictReader(io.StringIO(to_csv(hostile_rows(), "wd_regret", BOARD, HEAD, DATE)))
    )

    assert lines[1]["version"] == "'-1"
    assert float(lines[1]["ood_decay"]) == pytest.approx(-0.1)


@pytest.mark.parametrize(
    "start", ["=", "+", "-", "@", "\t=", " =", "\r=", "＝", "|", "%", "\x00=", "\u202e="]
)
def test_no_cell_begins_with_a_formula(start: str) -> None:
    rows = ranking([entry(3, scores(0.1, 0.2), submitter=f"{start}cmd")], "wd_regret")

    (line,) = csv.DictReader(io.StringIO(to_csv(rows, "wd_regret", BOARD, HEAD, DATE)))

    assert line["submitter"] == f"'{start[-1]}cmd"


def test_an_export_has_what_an_entry_ranks_by_its_steps_per_run_and_what_it_copies() -> None:
    copied = replace(
        entry(3, scores(0.3, 0.1)),
        runs=10,
        steps=1000,
        policies=10,
        alike=(Likeness("sha256:" + "a" * 64, "f" * 64, 2),),
    )
    rows = ranking([copied], "ood_decay")
    (line,) = csv.DictReader(io.StringIO(to_csv(rows, "ood_decay", BOARD, HEAD, DATE)))
    assert float(line["rank_value"]) == 0.0
    assert float(line["ood_decay"]) == pytest.approx(-0.2)
    assert (line["steps_per_run"], line["copied_runs"]) == ("100", "2")
    assert line["copy_of"] == "sha256:" + "a" * 64
    assert r"& 10 & 100 & " in to_latex(rows, "ood_decay", BOARD, HEAD, DATE)


def test_the_csv_has_every_score_with_its_interval() -> None:
    lines = list(
        csv.DictReader(io.StringIO(to_csv(hostile_rows(), "wd_regret", BOARD, HEAD, DATE)))
    )

    assert [line["first"] for line in lines] == ["", "1", "2", ""]
    row = lines[1]
    assert [
        float(row[name]) for name in ("wd_regret", "wd_regret_low", "wd_regret_high")
    ] == pytest.approx([0.3, 0.25, 0.35])
    assert float(row["normalised_regret_0"]) == pytest.approx(0.3)
    assert float(row["normalised_regret_5_high"]) == pytest.approx(0.25)


def test_latex_commands_in_names_are_escaped() -> None:
    text = to_latex(hostile_rows(), "wd_regret", BOARD, HEAD, DATE)

    line = next(line for line in text.splitlines() if "passwd" in line)
    assert line == (
        r"2 & \textbackslash{}input\{/etc/passwd\} 50\% \& \$x\_1\textasciicircum{}2\$ "
        r"\#\textasciitilde{} +1 & somebody & 60 & 16,667 & 2026-11-21 & "
        r"$0.600$ [$0.550$, $0.650$] & $0.700$ [$0.650$, $0.750$] & $0.100$ [$0.050$, $0.150$] \\"
    )


def test_a_name_of_two_lines_cannot_leave_its_line_of_latex() -> None:
    rows = ranking([entry(3, scores(0.1, 0.2), submitter="a\n\\end{tabular}\u2028b")], "wd_regret")

    lines = to_latex(rows, "wd_regret", BOARD, HEAD, DATE).splitlines()

    assert sum("tabular" in line for line in lines) == 3
    assert r"a \textbackslash{}end\{tabular\} b" in "\n".join(lines)


def test_the_json_has_the_whole_scores() -> None:
    plain = json.loads(to_json(hostile_rows(), "wd_regret", BOARD, HEAD, DATE))

    assert plain["metric"] == "wd_regret"
    assert [row["not_ranked"] for row in plain["rows"]] == ["reference", "", "", "reference"]
    assert Scores.from_dict(plain["rows"][1]["scores"]) == scores(0.3, 0.2)
    assert plain["rows"][1]["method"] == HOSTILE


@pytest.mark.parametrize("write", [to_csv, to_latex, to_json])
def test_every_export_names_its_suite_protocol_and_log(write: Any) -> None:
    text = write(hostile_rows(), "wd_regret", BOARD, HEAD, DATE).replace(r"\_", "_")

    for sentence in (
        "small_suite-v1",
        BOARD.suite.digest,
        "few-v1",
        BOARD.protocol.digest,
        HEAD[1],
        DATE,
    ):
        assert sentence in text
