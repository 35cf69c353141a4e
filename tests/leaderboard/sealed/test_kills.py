"""No step is lost or doubled when the server is killed; `benchmarks/sealed_kills.py` has more."""

from tests.leaderboard.sealed.killing import step_through_kills
from tests.leaderboard.sealed.playing import LANES, online_board
from tests.leaderboard.sealing import SETTING


def test_entrants_go_on_when_their_server_is_killed(tmp_path):
    member = {"name": "deep", "setting": SETTING, "instances": 1, "budget": 60 * LANES}
    board = online_board(tmp_path, classes=[member])
    step_through_kills(board, tickets=3, requests=60, kills=1)
