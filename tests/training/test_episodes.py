"""The log of finished episodes."""

import pytest

from sme_registry.errors import (
    OptionError,
)
from sme_registry.training.episodes import COLUMNS, Episode, EpisodeLog, read_episodes


def episode(number):
    return Episode(number, 20 * number, 1.5, 20, 0.25, 0.9, 0, 0.5)


def test_a_row_cut_short_and_rows_after_the_checkpoint_are_dropped(tmp_path):
    path = tmp_path / "episodes.csv"
    log = EpisodeLog(path)
    assert path.read_text() == ",".join(COLUMNS) + "\n"
    for number in (1, 2, 3):
        log.add(episode(number))
        assert len(read_episodes(path)) == number  # on disk before the next one begins
    log.close()
    with path.open("a") as stream:
        stream.write("4,80,1.5,2")
    assert read_episodes(path) == [episode(1), episode(2), episode(3)]
    EpisodeLog(path, up_to_step=45).close()
    assert read_episodes(path) == [episode(1), episode(2)]
    path.write_text("a,b\n1,2\n")
    with pytest.raises(OptionError, match="columns"):
        read_episodes(path)
