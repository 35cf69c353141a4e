"""What was computed once is kept, and the oldest is forgotten."""

from __future__ import annotations

from leaderboard.scoring.memo import Memo


def test_a_value_is_made_once_until_it_is_forgotten() -> None:
    memo: Memo[str] = Memo(2)
    made: list[str] = []

    def make(key: str) -> str:
        made.append(key)
        return key.upper()

    for key in ("a", "b", "a", "c", "b", "a"):
        assert memo.get(key, lambda key=key: make(key)) == key.upper()
    assert made == ["a", "b", "c", "a"]
