"""Rankings: who has a rank, which one, and the files in which others read it."""

import csv
import io
import random
from dataclasses import replace

import numpy as np
import pytest

from leaderboard.documents.result import RANKED, Copies, EntryRow, Estimate, Scores
from leaderboard.errors import NotPublishable
from leaderboard.scoring.ranking import ranking, refuse_unpublishable, superseded
from leaderboard.web.tables import RankingFile
from tests.leaderboard.conftest import document_of, tiny_suite

BOARD = document_of(tiny_suite(), suite_name="small_suite-v1")
HEAD = (7, "sha256:" + "ab" * 32)
DATE = "2026-11-21T09:30:00Z"


def scores(wd, ood, arm=0.05):
    def around(value):
        return Estimate(value=value, low=value - arm, high=value + arm)

    return Scores(
        wd_regret=around(wd),
        ood_regret=around(ood),
        ood_decay=around(ood - wd),
        regret_slope=around(0.0),
        similarity_loss=around(1.0),
        normalised_regret=(around(wd), *(around(ood) for _ in range(5))),
    )


def entry(sequence, values=None, **fields):
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


def reference(sequence, name, regret, **fields):
    values = scores(regret, regret, arm=0.0)
    return entry(sequence, values, method=name, reference=True, enough_runs=False, **fields)


REFERENCES = [reference(1, "optimal", 0.0), reference(2, "constant", 1.0)]


def ranks(metric, *entries):
    """Each row's entry, first and last rank, and why it has none."""
    rows = ranking(list(entries), metric)
    return [(row.entry.sequence, row.first, row.last, row.reason) for row in rows]


def reasons(*entries):
    return {sequence: reason for sequence, _, _, reason in ranks("wd_regret", *entries)}


def test_entries_are_ordered_with_the_ranks_that_their_intervals_allow():
    entries = [
        entry(3, scores(0.50, 0.6)),
        entry(4, scores(0.20, 0.6)),
        entry(5, scores(0.25, 0.6)),
        entry(6, scores(0.80, 0.9)),
    ]
    assert ranks("wd_regret", *entries) == [
        (4, 1, 2, ""),
        (5, 1, 2, ""),
        (3, 3, 3, ""),
        (6, 4, 4, ""),
    ]
    equal = [entry(sequence, scores(0.3, 0.4)) for sequence in (9, 4, 7)]
    assert list(reasons(*equal)) == [4, 7, 9]  # in order of submission


@pytest.mark.parametrize("metric", RANKED)
def test_nothing_has_no_rank(metric):
    assert ranking([], metric) == []


def test_unranked_entries_have_a_reason_and_take_no_rank():
    few, ranked = entry(3, scores(0.1, 0.2), enough_runs=False), entry(4, scores(0.3, 0.4))
    unlisted = [
        entry(5, status="waiting"),
        entry(6, status="rejected", code="schema"),
        entry(7, scores(0.1, 0.2), status="withdrawn"),
    ]
    assert ranks("wd_regret", *REFERENCES, few, ranked, *unlisted) == [
        (1, None, None, "reference"),
        (3, None, None, "too_few_runs"),
        (4, 1, 1, ""),
        (2, None, None, "reference"),
    ]


# By decay, sabotage inside the cube wins nothing


def by_decay(*entries):
    return [row[:3] for row in ranks("ood_decay", *entries)]


def test_a_policy_made_worse_inside_the_cube_stays_below_the_original():
    original = entry(3, scores(0.1, 0.3, 0.01))
    sabotaged = entry(4, scores(0.44, 0.3, 0.01))  # decay −0.14
    lucky = entry(4, scores(0.44, 0.299, 0.01))  # in the states of some regions
    assert by_decay(original, sabotaged) == by_decay(original, lucky) == [(3, 1, 2), (4, 1, 2)]
    row = ranking([original, sabotaged], "ood_decay")[1]
    assert (row.value.value, row.value.low) == pytest.approx((0.2, 0.19))
    assert sabotaged.scores.ood_decay.value == pytest.approx(-0.14)  # as scored
    honest = entry(4, scores(0.2, 0.29, 0.01))  # better in every outer region
    steep = entry(3, scores(0.1, 0.4, 0.01))
    assert by_decay(steep, honest) == [(4, 1, 1), (3, 2, 2)]


def test_an_entry_without_a_rank_holds_nobody_down():
    better = entry(3, scores(0.1, 0.3, 0.01), enough_runs=False)
    worse, other = entry(4, scores(0.4, 0.35, 0.01)), entry(5, scores(0.1, 0.2, 0.01))
    assert by_decay(better, worse) == [(4, 1, 1), (3, None, None)]
    assert by_decay(better, worse, other) == [(5, 1, 2), (4, 1, 2), (3, None, None)]


def test_no_entry_stands_above_one_that_is_better_in_every_region():
    rng = random.Random(1)
    entries = [entry(i, scores(rng.random() / 3, rng.random(), 0.01)) for i in range(3, 120)]
    rows = ranking(entries, "ood_decay")
    regrets = np.array([[e.value for e in row.entry.scores.normalised_regret] for row in rows])
    for i, row in enumerate(rows):
        better = (regrets <= regrets[i]).all(axis=1) & (regrets < regrets[i]).any(axis=1)
        assert better[i:].sum() == 0
        for j in np.flatnonzero(better):
            assert (rows[j].first, rows[j].last) <= (row.first, row.last)


# One row of a key's method, and none for copies


def test_the_latest_entry_of_a_key_with_the_same_method_and_version_is_ranked():
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
    for one, other in [("1.0", "10"), ("1.2", "1.3")]:
        versions = [replace(first, version=one), replace(other_version, version=other)]
        assert reasons(*versions) == {3: "", 5: ""}


def test_a_copy_of_another_key_has_no_rank_and_pushes_nobody_down():
    original = entry(3, scores(0.2, 0.3), policies=10)
    own = entry(5, scores(0.4, 0.5), key="2" * 64, policies=10)

    def thief(copied):
        alike = (Copies(copied[0].id, copied[0].key, copied[1]),)
        return entry(6, scores(0.1, 0.2), key="1" * 64, policies=10, alike=alike)

    assert reasons(original, thief((original, 5)), own) == {3: "", 6: "copy", 5: ""}
    assert reasons(original, thief((original, 4)), own) == {3: "", 6: "", 5: ""}
    rows = ranks("wd_regret", original, thief((original, 10)), own)
    assert [row[1] for row in rows if row[0] in (3, 5)] == [1, 2]


# The reference rows


def test_a_board_with_right_reference_rows_is_publishable():
    refuse_unpublishable(REFERENCES)
    refuse_unpublishable([reference(1, "optimal", 9e-7), reference(2, "constant", 1 - 9e-7)])
    off = reference(3, "optimal", 0.1)
    with pytest.raises(NotPublishable):
        refuse_unpublishable([*REFERENCES, off])
    refuse_unpublishable([*REFERENCES, replace(off, status="withdrawn")])
    values = REFERENCES[1].scores
    points = Estimate(value=2.2, low=2.0, high=2.4)  # the constant policy may lose points outside
    row = replace(REFERENCES[1], scores=values.model_copy(update={"similarity_loss": points}))
    refuse_unpublishable([REFERENCES[0], row])


def test_without_both_reference_rows_nothing_is_published():
    optimal, constant = REFERENCES
    for rows, match in [
        ([optimal, entry(3, scores(0.1, 0.2))], "'constant': missing: must be scored"),
        ([constant, entry(3, scores(0.1, 0.2))], "'optimal': missing: must be scored"),
        # A submission with the name is no reference row.
        ([replace(optimal, reference=False), constant], "'optimal': missing: must be scored"),
        ([optimal, replace(constant, status="waiting")], "waiting: must be scored"),
        ([optimal, replace(constant, status="rejected")], "rejected: must be scored"),
        ([optimal, replace(constant, status="withdrawn")], "withdrawn: must be scored"),
    ]:
        with pytest.raises(NotPublishable, match=match):
            refuse_unpublishable(rows)


@pytest.mark.parametrize("name", ["wd_regret", "ood_decay", "regret_slope", 0, 5])
def test_a_wrong_reference_row_blocks_publication_in_any_region_or_metric(name):
    rows = (0,) if name == "ood_decay" else (0, 1)  # that of ½ depends on the task
    for which, off in [(row, off) for row in rows for off in (2e-6, -2e-6)]:
        plain = REFERENCES[which].scores.to_dict()
        estimate = plain["normalised_regret"][name] if isinstance(name, int) else plain[name]
        estimate["value"] += off
        altered = list(REFERENCES)
        altered[which] = replace(altered[which], scores=Scores.from_dict(plain))
        with pytest.raises(NotPublishable, match=f"{altered[which].method}.*{name}="):
            refuse_unpublishable(altered)


# As files

HOSTILE = '=HYPERLINK("http://x","y")'


def hostile_rows():
    evil = entry(3, scores(0.3, 0.2), method=HOSTILE, submitter="a;=1+1\r\n=2", version="-1")
    tex = entry(4, scores(0.6, 0.7), method=r"\input{/etc/passwd} 50% & $x_1^2$ #~", version="+1")
    return ranking([*REFERENCES, evil, tex], "wd_regret")


def file(rows, metric="wd_regret"):
    return RankingFile(rows, metric, BOARD, HEAD, DATE)


def csv_of(rows, metric="wd_regret"):
    return list(csv.DictReader(io.StringIO(file(rows, metric).to_csv())))


def test_no_cell_of_the_csv_is_a_formula():
    lines = csv_of(hostile_rows())
    assert len(lines) == 4
    for line in lines:
        for name, cell in line.items():
            try:
                float(cell)
            except ValueError:
                assert not cell.startswith(("=", "+", "-", "@", "\t", "\r")), (name, cell)
    assert lines[1]["method"] == "'" + HOSTILE
    assert lines[1]["version"] == "'-1"  # text that looks like a negative number stays text
    assert float(lines[1]["ood_decay"]) == pytest.approx(-0.1)
    text = file(hostile_rows()).to_csv()
    assert '"a;=1+1 =2"' in text  # whole in its quotes, where semicolons split cells, too
    for start in ["=", "+", "-", "@", "\t=", " =", "\r=", "＝", "|", "%"]:
        (line,) = csv_of(
            ranking([entry(3, scores(0.1, 0.2), submitter=f"{start}cmd")], "wd_regret")
        )
        assert line["submitter"] == f"'{start[-1]}cmd"
    (line,) = csv_of(ranking([entry(3, scores(0.1, 0.2), submitter="\x00\u202e=cmd")], "wd_regret"))
    assert line["submitter"] == r"\x00\u202e=cmd"


def test_the_csv_has_every_score_with_its_interval():
    lines = csv_of(hostile_rows())
    assert [line["first"] for line in lines] == ["", "1", "2", ""]
    row = lines[1]
    names = ("wd_regret", "wd_regret_low", "wd_regret_high")
    assert [float(row[name]) for name in names] == pytest.approx([0.3, 0.25, 0.35])
    assert float(row["normalised_regret_0"]) == pytest.approx(0.3)
    assert float(row["normalised_regret_5_high"]) == pytest.approx(0.25)


def test_an_export_has_what_an_entry_ranks_by_its_steps_per_run_and_what_it_copies():
    alike = (Copies("sha256:" + "a" * 64, "f" * 64, 2),)
    copied = entry(3, scores(0.3, 0.1), runs=10, steps=1000, policies=10, alike=alike)
    rows = ranking([copied], "ood_decay")
    (line,) = csv_of(rows, "ood_decay")
    assert float(line["rank_value"]) == 0.0
    assert float(line["ood_decay"]) == pytest.approx(-0.2)
    assert (line["steps_per_run"], line["copied_runs"]) == ("100", "2")
    assert line["copy_of"] == "sha256:" + "a" * 64
    assert r"& 10 & 100 & " in file(rows, "ood_decay").to_latex()


def test_names_are_escaped_in_latex_and_stay_on_their_line():
    text = file(hostile_rows()).to_latex()
    line = next(line for line in text.splitlines() if "passwd" in line)
    assert line == (
        r"2 & \textbackslash{}input\{/etc/passwd\} 50\% \& \$x\_1\textasciicircum{}2\$ "
        r"\#\textasciitilde{} +1 & somebody & 60 & 16,667 & 2026-11-21 & "
        r"$0.600$ [$0.550$, $0.650$] & $0.700$ [$0.650$, $0.750$] & $0.100$ [$0.050$, $0.150$] \\"
    )
    rows = ranking([entry(3, scores(0.1, 0.2), submitter="a\n\\end{tabular}\u2028b")], "wd_regret")
    lines = file(rows).to_latex().splitlines()
    assert sum("tabular" in line for line in lines) == 3
    assert r"a \textbackslash{}end\{tabular\} b" in "\n".join(lines)


def test_the_json_has_the_whole_scores():
    plain = file(hostile_rows()).to_dict()
    assert plain["metric"] == "wd_regret"
    assert [row["not_ranked"] for row in plain["rows"]] == ["reference", "", "", "reference"]
    assert Scores.from_dict(plain["rows"][1]["scores"]) == scores(0.3, 0.2)
    assert plain["rows"][1]["method"] == HOSTILE


def test_every_export_names_its_suite_protocol_and_log():
    ranked = file(hostile_rows())
    suite, protocol = BOARD.suite.digest, BOARD.protocol.digest
    for text in (ranked.to_csv(), ranked.to_latex(), str(ranked.to_dict())):
        for fact in ("small_suite-v1", suite, "few-v1", protocol, HEAD[1], DATE):
            assert fact in text.replace(r"\_", "_")
