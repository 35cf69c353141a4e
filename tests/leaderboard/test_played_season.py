"""The seasons of `docs/results/season.md`: small, whole, and open to anyone's replay."""

import shutil
from pathlib import Path

import pytest

from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.season import counting, season_rankings
from leaderboard.sealed import verify_season
from leaderboard.store import Store

BOARD = Path(__file__).resolve().parents[2] / "docs" / "results" / "season" / "board"


def results(store, season):
    """The counting results of a season by method."""
    found = {}
    for row in counting(store, store.season(season)):
        result = store.sealed_result(row)
        assert result is not None
        found[row.entrant.method] = result
    return found


def tops(ranked):
    """Methods and their N₀."""
    for row in ranked:
        assert row.entry.scores is not None
        yield row.entry.method, row.entry.scores.wd_regret.value


def test_both_seasons_are_ranked_as_the_page_says():
    with Store.open(BOARD, read_only=True) as store:
        for season, best in (("winter", ["SAC", "PPO"]), ("autumn", ["IQL", "BC"])):
            document = store.season(season)
            assert document.is_committed_to(store.revealed_master(season))
            ranked = season_rankings(store, document, "wd_regret")
            names = [row.entry.method for row in ranked["generic"]]
            assert set(best) < set(names)
            assert names[-1] == "Constant 0.5"
            own, others = (dict(tops(ranked[kind])) for kind in ("family", "generic"))
            assert all(own["Family fit (short)"] < others[name] for name in best)
    assert not list(BOARD.rglob("*.key"))
    assert sum(path.stat().st_size for path in BOARD.rglob("*") if path.is_file()) < 3_500_000


def test_the_online_season_is_replayed_from_its_journals():
    with Store.open(BOARD, read_only=True) as store:
        report = verify_season(store, "winter")
        assert (report.entries, report.results) == (5, 5)
        for result in results(store, "winter").values():
            assert {each.steps for each in result.stepping} <= {0, 10_000}


def test_the_offline_season_is_replayed_from_its_master():
    """Its data sets are not committed; another processor may round them otherwise."""
    with Store.open(BOARD, read_only=True) as store:
        try:
            report = verify_season(store, "autumn")
        except BoardError as error:
            if "generated again on this machine" not in str(error):
                raise
            pytest.skip(str(error))
        assert (report.instances, report.rounded, report.results) == (6, 0, 6)


@pytest.mark.parametrize("kind", ["journal", "npy"])
def test_an_altered_byte_is_found(tmp_path, kind):
    board = tmp_path / "board"
    shutil.copytree(BOARD, board)
    file = next(board.glob(f"seasons/*/tickets/1/2.{kind}"))
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with (
        Store.open(board, read_only=True) as store,
        pytest.raises((TamperedError, BoardError), match=r"tickets/1/2\.(journal|npy|json)"),
    ):
        verify_season(store, "winter")
