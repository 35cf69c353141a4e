"""`episodes.csv`: one row for each finished episode, written as soon as it ends.

That of a team has one more column for each agent, `regret/<agent>`; that of a task with `safety`
has `cost`, `violating_share` and `safe_regret`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from sme_registry.envs.episodes import Episode, EpisodeSafety
from sme_registry.errors import OptionError
from sme_registry.io import write_atomically

FILE = "episodes.csv"
_AGENT_PREFIX = "regret/"


COLUMNS = Episode._fields[:-2]
SAFETY = EpisodeSafety._fields
_TYPES = (int, int, float, int, float, float, int, float)


def read_episodes(path: Path) -> list[Episode]:
    """All complete rows; one that was cut off by a kill is skipped.

    Examples:
      >>> from pathlib import Path
      >>> from sme_registry.training import read_episodes
      >>> read_episodes(Path("runs/ppo/episodes.csv"))[0].length
      100
    """
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: cannot be read: {error}. Give an episodes.csv.") from None
    head = rows[0] if rows else []
    columns, others = tuple(head[: len(COLUMNS)]), tuple(head[len(COLUMNS) :])
    by_agent = all(column.startswith(_AGENT_PREFIX) for column in others)
    if columns != COLUMNS or not (by_agent or others == SAFETY):
        raise OptionError(
            f"{path}: the columns must be {','.join(COLUMNS)}, and for a team "
            f"{_AGENT_PREFIX}<agent>, or for a task with safety {','.join(SAFETY)}."
        )
    episodes = []
    for row in rows[1:]:
        try:
            kinds = zip(_TYPES + (float,) * len(others), row, strict=True)
            values = [kind(text) for kind, text in kinds]
        except ValueError:  # a number or a column is missing
            break
        own, rest = values[: len(COLUMNS)], tuple(values[len(COLUMNS) :])
        episode = Episode._make((*own, (), EpisodeSafety(*rest) if others == SAFETY else None))
        episodes.append(episode._replace(agents_regret=rest) if by_agent else episode)
    return episodes


class EpisodeLog:
    """Appends rows and flushes each, so that a killed run keeps all finished episodes."""

    def __init__(self, path: Path, up_to_step: int = 0, agents: Sequence[str] = ()) -> None:
        self.agents = agents
        kept = read_episodes(path) if up_to_step and path.exists() else []
        self.episodes = [episode for episode in kept if episode.step <= up_to_step]
        self._path = path
        self._write()

    def _write(self) -> None:
        """Write the head and the rows so far, and open the file for more."""
        text = io.StringIO()
        safety = SAFETY if self.episodes and self.episodes[0].safety is not None else ()
        head = [*COLUMNS, *safety, *(f"{_AGENT_PREFIX}{agent}" for agent in self.agents)]
        csv.writer(text, lineterminator="\n").writerows([head, *map(_row, self.episodes)])
        write_atomically(self._path, text.getvalue())
        self._stream = self._path.open("a", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream, lineterminator="\n")

    def add(self, episode: Episode) -> None:
        """Append one row."""
        self.episodes.append(episode)
        if len(self.episodes) == 1 and episode.safety is not None:  # which has columns of its own
            self.close()
            self._write()
            return
        self._writer.writerow(_row(episode))
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _row(episode: Episode) -> list[int | str]:
    *values, agents, safety = episode
    row = (*values, *(safety or ()), *agents)
    return [format(v, ".9g") if isinstance(v, float) else v for v in row]
