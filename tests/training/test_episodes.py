"""The log of finished episodes."""

from __future__ import annotations

from pathlib import Path

import pytest

from sme_registry.errors import (
    OptionError,
)
from sme_registry.training.episodes import COLUMNS, Episode, EpisodeLog, read_episodes


def episode(number: int) -> Episode:
    return Episode(number, 20 * number, 1.5, 20, 0.25, 0.9, 0, 0.5)


def test_each_episode_is_on_disk_before_the_next_begins(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    log = EpisodeLog(path)
    assert path.read_text() == ",".join(COLUMNS) + "\n"
    log.add(episode(1))
    assert read_episodes(path) == [episode(1)]
    log.close()


def test_a_row_cut_short_and_rows_after_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    log = EpisodeLog(path)
    for number in (1, 2, 3):
        log.add(episode(number))
    log.close()
    with path.open("a") as stream:
        stream.write("4,80,1.5,2")
    assert read_episodes(path) == [episode(1), episode(2), episode(3)]
    EpisodeLog(path, up_to_step=45).close()
    assert read_episodes(path) == [episode(1), episode(2)]


def test_a_csv_with_other_columns_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(OptionError, match="columns"):
        read_episodes(path)
