"""`write_site`: a board's pages in a folder."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from leaderboard.documents.board import Folder
from leaderboard.store import Store
from leaderboard.store.files import write_file
from leaderboard.web.site.pages import Pages
from sme_registry.errors import OptionError

_WRITERS = 8  # threads that wait for the disk


def write_site(
    store: Store,
    out: str | Path,
    progress: Callable[[int, int], None] | None = None,
    *,
    explorers: bool = False,
) -> Path:
    """Write the board's pages into a folder. Each file is written completely or not at all.

    The same board gives the same bytes. Unchanged files and other files are left alone.

    Args:
      store: an open store; it is only read.
      out: the folder; created if it is missing.
      progress: called with the number of files written and of all files.
      explorers: whether to write an explorer of each run of each scored submission, of 60 kB or
        more and in a second each.

    Returns:
      The path of `index.html`.

    Raises:
      NotPublishable: the reference rows are missing or differ from 0 and 1; nothing is written.
      OptionError: the folder is a board, or a folder of a board's files.
      BoardError: a file cannot be written.
    """
    out = Path(out)
    _refuse_board(out)
    pages = Pages(store, explorers=explorers)
    paths = list(pages.paths())

    def write(path: str, content: bytes) -> None:
        target = out / path
        if not (target.is_file() and target.read_bytes() == content):
            write_file(target, content)

    # This thread renders, because it holds the store; the others wait for the disk.
    with ThreadPoolExecutor(_WRITERS) as pool:
        pending: deque[Future[None]] = deque()
        for done, path in enumerate(paths, start=1):
            content = pages.read(path)
            assert content is not None, path
            if path == "index.html":
                _wait(pending, 0)  # every link of the page works once it exists
            pending.append(pool.submit(write, path, content))
            _wait(pending, 4 * _WRITERS)
            if progress is not None:
                progress(done, len(paths))
        _wait(pending, 0)
    return out / "index.html"


def _refuse_board(out: Path) -> None:
    """Refuse a folder in which pages would replace a board's files. A site has a board.json too."""
    target = out.resolve()
    for above in (target, *target.parents):
        board = Folder(above)
        if not (board.key.exists() or (board.board.is_file() and board.log.is_dir())):
            continue
        folders = (
            *(board.log, board.objects, board.results, board.seasons),
            *(board.submissions, board.withdrawals),
        )
        if target == above or any(target.is_relative_to(each.resolve()) for each in folders):
            raise OptionError(
                f"out={str(out)!r}: belongs to the board {above}, whose files the pages would "
                f"replace. Give another folder, such as {above / 'site'}."
            )


def _wait(pending: deque[Future[None]], left: int) -> None:
    """Wait until at most `left` writes are pending, and raise their errors."""
    while len(pending) > left:
        pending.popleft().result()
