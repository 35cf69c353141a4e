"""`episodes.csv`: one row for each finished episode, on disk as soon as it has ended.

A team's has a column more for each agent, `regret/<agent>`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sme_registry.errors import OptionError
from sme_registry.io import write_atomically

FILE = "episodes.csv"
_OF_AGENT = "regret/"


class Episode(NamedTuple):
    """A finished episode; of a team, one episode of the whole team.

    Attributes:
      episode: its number, from 1.
      step: environment steps of the whole run when it ended, over all environments; a step of a
        team is one step of all its agents.
      episode_return: the sum of its rewards, in [0, T]; the column is called `return`.
      length: its steps.
      regret: mean regret 1 − r over its steps, in [0, 1]; exact.
      similarity: mean r̃ over its steps, in [0, 1]; exact.
      terminated: 1 where it ended by D, 0 where its time was up.
      wall_seconds: of training, over all sessions, when it ended.
      agents_regret: each agent's mean regret, in the team's order; empty where there is no
        team. Of a team the numbers above (return, regret, similarity) are the mean over
        its agents.
    """

    episode: int
    step: int
    episode_return: float
    length: int
    regret: float
    similarity: float
    terminated: int
    wall_seconds: float
    agents_regret: tuple[float, ...] = ()


COLUMNS = tuple("return" if f == "episode_return" else f for f in Episode._fields[:-1])
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
    head = rows[0] if rows else []
    own, agents = tuple(head[: len(COLUMNS)]), head[len(COLUMNS) :]
    if own != COLUMNS or not all(column.startswith(_OF_AGENT) for column in agents):
        raise OptionError(
            f"{path}: its columns must be {','.join(COLUMNS)}, and of a team {_OF_AGENT}<agent>."
        )
    episodes = []
    for row in rows[1:]:
        try:
            if len(row) != len(head):
                break
            values = [kind(text) for kind, text in zip(_TYPES, row, strict=False)]
            regrets = tuple(map(float, row[len(COLUMNS) :]))
        except ValueError:
            break
        episodes.append(Episode._make((*values, regrets)))
    return episodes


class EpisodeLog:
    """Appends rows, each flushed as it is written: a killed run keeps all it has finished.

    Args:
      path: the file. Rows after `up_to_step`, which a resumed run will live through again, are
        dropped; so is a row that a kill cut short.
      up_to_step: the step of the checkpoint that the run goes on from; 0 begins anew.
      agents: the agents of the team, each with a column; none where there is no team.
    """

    def __init__(self, path: Path, up_to_step: int = 0, agents: Sequence[str] = ()) -> None:
        kept = read_episodes(path) if up_to_step and path.exists() else []
        self.episodes = [episode for episode in kept if episode.step <= up_to_step]
        text = io.StringIO()
        head = [*COLUMNS, *(f"{_OF_AGENT}{agent}" for agent in agents)]
        csv.writer(text, lineterminator="\n").writerows([head, *map(_row, self.episodes)])
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
    *own, agents = episode
    return [format(v, ".9g") if isinstance(v, float) else v for v in (*own, *agents)]
