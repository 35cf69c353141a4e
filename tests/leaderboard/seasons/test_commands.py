"""The commands of an offline season, as they are typed, on a folder and over HTTP."""

import json
import stat
from pathlib import Path

import numpy as np
import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.seasons.publication import read_season
from leaderboard.seasons.season import Master
from leaderboard.seasons.store import SeasonStore
from sme_registry.seasons.wire import pack_table, unpack_table
from tests.leaderboard.conftest import linear_onnx, tiny_board
from tests.leaderboard.seasons.sealing import tiny_terms
from tests.leaderboard.serving import serving
from tests.leaderboard.test_cli import board_command, fails, good

PLAN = "plan.json"
ENTER = ("--method", "Test", "--submitter", "A Lab")
OTHER = ("--key", "other.key")
LONG = "x" * 300


@pytest.fixture(autouse=True)
def _furnished(home):
    """A board, keys and the plan of a season."""
    SigningKey.generate().write("my.key")
    SigningKey.generate().write("other.key")
    tiny_board(home / "board").close()
    fields = tiny_terms(id="autumn").to_dict()
    del fields["published"]
    Path(PLAN).write_text(json.dumps(fields))


@pytest.fixture
def season():
    good("season", "new", "board", PLAN)
    good("season", "publish", "board", "autumn")
    return Path("autumn")


def facts(*arguments):
    return json.loads(good("season", *arguments, "--json"))


def counts(*arguments):
    rows = json.loads(good(*arguments, "--json"))["rows"]
    return {row["what"]: (row["checked"], row["unchecked"]) for row in rows}


def test_a_season_is_played_from_the_command_line(later):
    printed = good("season", "new", "board", PLAN)
    secret = Path("board.autumn.master")
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert Master.read(secret).raw.hex() not in printed
    season = read_season("autumn")
    assert season.commitment in printed
    assert season.is_committed_to(Master.read(secret))
    assert "already exists" in fails(2, "season", "new", "board", PLAN)
    assert Master.read(secret)

    good("season", "publish", "board", "autumn")
    [announced] = facts("show", "board")
    assert (announced["state"], announced["commitment"]) == ("open", season.commitment)
    answers = np.full((300, 1), 0.25, np.float32)
    Path("deep-0.npy").write_bytes(pack_table(answers))
    id = good("enter", "board", "autumn", "{name}.npy", "--failed", "deep-1", *ENTER).strip()
    assert "season_not_closed" in fails(1, "season", "close", "board", "autumn")
    assert "season_not_closed" in fails(1, "season", "reveal", "board", "autumn")
    assert counts("verify", "board")["autumn: data sets, by their digests"] == (2, 0)
    assert counts("verify", "board")["autumn: results, scored again"] == (0, 1)

    later()
    assert "log entry 2" in good("season", "close", "board", "autumn")
    Master(bytes(32)).write("other.master")
    wrong = fails(1, "season", "reveal", "board", "autumn", "--secret", "other.master")
    assert "reveal_mismatch" in wrong
    assert "1 entry scored" in good("season", "reveal", "board", "autumn")
    assert "1 entry scored" in good("season", "reveal", "board", "autumn")
    checked = counts("verify", "board")
    assert checked["autumn: data sets"] == (2, 0)
    assert checked["autumn: results, scored again"] == (1, 0)
    shown = facts("show", "board", "autumn")
    assert shown["state"] == "revealed"
    [row] = shown["ranking"]["generic"]
    assert (row["id"], row["first"], row["last"]) == (id, 1, 1)
    assert (row["methods_of_key"], row["entries_of_key"]) == (1, 1)
    assert shown["ranking"]["family"] == []
    assert "Test 1" in good("season", "show", "board", "autumn", "--metric", "ood_regret")
    assert "revealed" in good("season", "show", "board")
    assert (shown["keys"], shown["entries"], shown["admitted"]) == (1, 1, None)
    assert "None" not in good("season", "show", "board", "autumn")


@pytest.mark.parametrize("target", ["my.key", "/dev/zero"])
def test_only_the_files_of_a_season_are_published(target):
    """A link in its folder could add a private file, or a device that has no end."""
    good("season", "new", "board", PLAN)
    data = Path("autumn/datasets/sealed/autumn/deep-1-v0/data")
    (data / "more").symlink_to(Path(target).absolute())
    if target == "my.key":
        good("season", "publish", "board", "autumn")
        assert not list(Path("board").rglob("more"))
        return
    (data / "metadata.json").unlink()
    (data / "metadata.json").symlink_to(target)
    (data / "more").unlink()
    shown = fails(2, "season", "publish", "board", "autumn")
    assert "metadata.json: cannot be read: is not a regular file" in shown


def test_a_class_that_a_table_solves_is_warned_of_and_a_false_plan_is_refused(tmp_path):
    fields = json.loads(Path(PLAN).read_text())
    setting = fields["classes"][0]["setting"]
    for state_dim, warned in ((2, True), (8, False)):
        fields["id"], setting["state_dim"] = f"s{state_dim}", state_dim
        Path(PLAN).write_text(json.dumps(fields))
        made = board_command("season", "new", "board", PLAN)
        assert made.exit_code == 0
        assert ("Warning: classes.deep: a table of the nearest states" in made.stderr) == warned
    fields["id"], setting["complexity"] = "shallow", 4
    Path(PLAN).write_text(json.dumps(fields))
    assert "complexity=4: must be at least 5" in fails(2, "season", "new", "board", PLAN)
    assert not list(tmp_path.glob("*shallow*"))
    assert "season_unknown" in fails(1, "season", "show", "board", "winter")


@pytest.mark.parametrize(
    "arguments",
    [
        ("season", "show", LONG),
        ("season", "reveal", "board", "autumn", "--secret", LONG),
        ("ticket", "https://board.example", "winter", "--out", LONG, *ENTER),
        ("enter", "board", "autumn", "{name}" + LONG + ".zip", *ENTER),
    ],
)
def test_a_name_that_no_file_can_have_is_refused(season, arguments):
    assert "too long. Give a shorter name." in fails(2, *arguments)


def entered(*arguments):
    """The answers of an entry that is sent."""
    id = good("enter", "board", "autumn", *arguments, *ENTER).strip()
    with SeasonStore.open("board", read_only=True) as store:
        row = store.entrant(id)
        assert row is not None
        answers = store.entry_of(row).content.answers
        return [
            None if each is None else unpack_table(store.objects.read(each.sha256), 1)
            for each in answers
        ]


def test_files_policies_and_constants_are_entered_as_actions(season):
    names = ("deep-0", "deep-1")
    shown = [
        unpack_table((season / "challenges" / f"{name}.npy").read_bytes(), 4) for name in names
    ]
    for name, states in zip(names, shown, strict=True):
        Path(f"{name}.npy").write_bytes(pack_table(states[:, :1]))
    for states, actions in zip(shown, entered("{name}.npy"), strict=True):
        np.testing.assert_array_equal(actions, states[:, :1])
    Path("deep-0.onnx").write_bytes(linear_onnx(0))
    actions, nothing = entered("{name}.onnx", "--failed", "deep-1")
    expected = np.clip(0.1 * shown[0].sum(axis=1, keepdims=True), 0, 1)
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    assert nothing is None
    for actions in entered("constant"):
        np.testing.assert_array_equal(actions, np.full((300, 1), 0.5))
    enter = ("enter", "board", season)
    assert "must contain {name}" in fails(2, *enter, "x.onnx", *ENTER)
    wrong = fails(2, *enter, "{name}.npy", "--failed", "deep-2", *ENTER)
    assert "must be one of deep-0, deep-1" in wrong
    assert "cannot be read" in fails(2, *enter, "missing-{name}.npy", *ENTER)


def test_an_entry_is_sent_to_a_served_board(season):
    for name in ("deep-0", "deep-1"):
        Path(f"{name}.npy").write_bytes(pack_table(np.full((300, 1), 0.5, np.float32)))
    Path("bad-deep-0.npy").write_bytes(pack_table(np.full((299, 1), 0.5, np.float32)))
    with serving(Path("board")) as url:
        id = good("enter", url, season, "{name}.npy", *ENTER).strip()
        bad = ("enter", url, season, "bad-{name}.npy", "--failed", "deep-1", *ENTER)
        assert "answer_shape" in fails(1, *bad)
        good("fetch", url, "copy")
        good("fetch", url, "small", "--without-data")
    assert counts("verify", "copy")["autumn: data sets, by their digests"] == (2, 0)
    assert counts("verify", "small")["autumn: data sets"] == (0, 2)
    assert counts("verify", "copy")["files by their digests"] == (2, 1)  # answers are secret
    with SeasonStore.open("board", read_only=True) as store:
        assert [row.id for row in store.entrants(read_season(season).digest)] == [id]


def test_keys_are_admitted_to_a_season_with_a_list():
    fields = {**json.loads(Path(PLAN).read_text()), "admission": "listed"}
    Path(PLAN).write_text(json.dumps(fields))
    good("season", "new", "board", PLAN)
    good("season", "publish", "board", "autumn")
    admit = ("season", "admit", "board", "autumn")
    for expected in ("Admitted: Listed Lab.", "Admitted before: Listed Lab."):
        assert expected in good(*admit, SigningKey.read("my.key").public, "Listed Lab")
    assert "not_admitted" in fails(1, "enter", "board", "autumn", "constant", *ENTER, *OTHER)
    good("enter", "board", "autumn", "constant", *ENTER)
    shown = facts("show", "board", "autumn")
    assert (shown["admission"], shown["admitted"]) == ("listed", 1)
    assert "key" in fails(2, *admit, "abc", "A Lab")
