"""A table of the nearest states solves few channels, and not many."""

from leaderboard.scoring import tables
from leaderboard.scoring.tables import EASY, table_regret
from sme_registry.spec import Setting


def setting(state_dim):
    return Setting(state_dim=state_dim, action_dim=1, complexity=5, hidden_width=16)


def test_few_state_channels_are_filled_by_a_table_and_many_are_not():
    one, eight = table_regret(setting(1), 1000), table_regret(setting(8), 1000)
    assert one < 0.01 < EASY < 0.2 < eight < 0.6


def test_more_rows_make_a_better_table_and_one_row_is_enough():
    one, hundred, thousands = (table_regret(setting(2), rows) for rows in (1, 100, 3000))
    assert thousands < hundred < one < 2


def test_the_number_of_neighbours_that_answers_best_counts(monkeypatch):
    each = []
    for count in (1, 8):
        with monkeypatch.context() as patch:
            patch.setattr(tables, "_NEIGHBOURS", (count,))
            each.append(table_regret(setting(8), 300))
    assert table_regret(setting(8), 300) <= min(each) < max(each)
