"""`episodes.csv`: one row for each finished episode, on disk as soon as it has ended."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

from sme_registry.errors import OptionError
from sme_registry.files import write_atomically

FILE = "episodes.csv"


class Episode(NamedTuple):
    """A finished episode.

    Attributes:
      episode: its number, from 1.
      step: environment steps of the whole run when it ended, over all lanes.
      episode_return: the sum of its rewards, in [0, T]; the column is called `return`.
      length: its steps.
      mean_regret: mean regret 1 − r over its steps, in [0, 1]; exact.
      mean_similarity: mean r̃ over its steps, in [0, 1]; exact.
      terminated: 1 where it ended by D, 0 where its time was up.
      wall_seconds: of training, over all sessions, when it ended.
    """

    episode: int
    step: int
    episode_return: float
    length: int
    mean_regret: float
    mean_similarity: float
    terminated: int
    wall_seconds: float


COLUMNS = tuple("return" if field == "episode_return" else field for field in Episode._fields)
_TYPES = (int, int, float, int, float, float, int, float)


def read_episodes(path: Path) -> list[Episode]:
    """Every whole row; one that a kill cut short is left out.

    Raises:
      OptionError: the file has other columns, or cannot be read.
    """
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: cannot be read: {error}. Give an episodes.csv.") from None
    if not rows or tuple(rows[0]) != COLUMNS:
        raise OptionError(f"{path}: its columns must be {','.join(COLUMNS)}.")
    episodes = []
    for row in rows[1:]:
        try:
            values = [kind(text) for kind, text in zip(_TYPES, row, strict=True)]
        except ValueError:
            break
        episodes.append(Episode(*values))
    return episodes


class EpisodeLog:
    """Appends rows, each flushed as it is written: a killed run keeps all it has finished.

    Args:
      path: the file. Rows after `up_to_step`, which a resumed run will live through again, are
        dropped; so is a row that a kill cut short.
      up_to_step: the step of the checkpoint that the run goes on from; 0 begins anew.
    """

    def __init__(self, path: Path, up_to_step: int = 0) -> None:
        kept = read_episodes(path) if up_to_step and path.exists() else []
        self.episodes = [episode for episode in kept if episode.step <= up_to_step]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *map(_row, self.episodes)])
        write_atomically(path, text.getvalue())
        self._stream = path.open("a", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream, lineterminator="\n")

    def add(self, episode: Episode) -> None:
        """Write one row."""
        self.episodes.append(episode)
        self._writer.writerow(_row(episode))
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _row(episode: Episode) -> list[int | str]:
    return [format(v, ".9g") if isinstance(v, float) else v for v in episode]
