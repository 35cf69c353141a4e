"""A board for others: `serve` is the application under uvicorn, `write_site` a folder of pages.

Clients that are silent, slow or too many are the business of the reverse proxy in front of it,
whose configuration is examples/deploy/nginx.conf: it passes on complete requests only. So this
server listens on this machine alone, unless it is told that a proxy is in front.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import signal
import socket
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from leaderboard.documents.board import Folder
from leaderboard.errors import BoardError
from leaderboard.store import Store
from leaderboard.store.blobs import write_file
from leaderboard.web.pages import Pages, Section
from sme_registry.errors import OptionError
from sme_registry.io import require_packages

if TYPE_CHECKING:
    import uvicorn
    from fastapi import FastAPI

_CONNECTIONS = 800  # and so fewer open files than the 1,024 that systems usually allow
_HEAD_BYTES = 2**14
_WRITERS = 8  # threads of `write_site` that wait for the disk
# Its characters need no quotes in the commands that the pages show.
_PUBLIC_URL = re.compile(r"https?://([\w.-]+|\[[\da-fA-F:]+\])(:\d{1,5})?(/[\w.~-]+)*/?", re.ASCII)


def serve(
    path: str | os.PathLike[str],
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    announce: Callable[[str], None] = print,
    url: str = "",
    behind_proxy: bool = False,
    unsafe_no_sandbox: bool = False,
    season_secrets: Iterable[str | os.PathLike[str]] = (),
) -> None:
    """Serve a board and run its scorers until Ctrl-C or SIGTERM, which both end it cleanly.

    Call it in the main thread, where signals arrive. Any address but the loopback needs
    `behind_proxy`; port 0 is any free one; `announce` gets the URL once it listens. What is sent is
    signed for `url`, by default where it listens. With `unsafe_no_sandbox`, submitted policies
    could read the files of this account and use the network: nobody else may submit.
    """
    if url and not _PUBLIC_URL.fullmatch(url):
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Give the address at which "
            "others reach the board."
        )
    if not behind_proxy and not _is_loopback(host):
        raise OptionError(
            f"host={host!r:.80}: must be a loopback address, such as 127.0.0.1. Put a reverse "
            "proxy in front of it; if only the proxy reaches this address, add --behind-proxy."
        )
    secrets = list(season_secrets)
    if unsafe_no_sandbox and workers and secrets:
        raise OptionError(
            "unsafe_no_sandbox=True: must be False with season_secrets, which submitted policies "
            "could read. Install bubblewrap, or score no submissions (--workers 0)."
        )
    if behind_proxy and not url:
        raise OptionError(
            "url='': must be the address at which the proxy is reached, such as "
            "https://board.example: what is sent to a board is signed for its address."
        )
    require_packages("serving a board", {"fastapi": "FastAPI", "uvicorn": "uvicorn"}, "leaderboard")
    import uvicorn

    from leaderboard.web.app import create_app

    with listen(host, port) as listener:
        app = create_app(
            path,
            url or url_of(listener),
            score_workers=workers,
            isolation="process" if unsafe_no_sandbox else "bwrap",
            season_secrets=secrets,
        )
        announce(url_of(listener))
        # Uvicorn shuts down on both signals, then raises the one it received.
        previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn.Server(server_config(app)).run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, previous)


def server_config(app: FastAPI) -> uvicorn.Config:
    import uvicorn

    return uvicorn.Config(
        app,
        loop="asyncio",
        http="h11",  # always the same parser, whatever else is installed
        ws="none",
        h11_max_incomplete_event_size=_HEAD_BYTES,
        limit_concurrency=_CONNECTIONS,
        log_config=None,  # as all other logs
        log_level="error",  # a client's faults are not the server's
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=5,
    )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BoardError(
            f"host={host!r}, port={port}: cannot listen here: {reason}. Use another --port."
        ) from None
    # Asyncio does not, where it is given a socket: head and body of an answer were 40 ms apart.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def url_of(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def write_site(
    store: Store,
    out: str | Path,
    progress: Callable[[int, int], None] | None = None,
    *,
    explorers: bool = False,
    sections: Sequence[Section] = (),
) -> Path:
    """Write the board's pages into a folder, and return the path of `index.html`.

    Each file is written completely or not at all. The same board gives the same bytes. Unchanged
    files and other files are left alone. Explorers, of each run of each scored submission, have
    60 kB or more and take a second each.
    """
    out = Path(out)
    _refuse_board(out)
    pages = Pages(store, explorers=explorers, sections=sections)
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
        folders = ("log", "objects", "seasons", "submissions", "withdrawals", "results")
        own = [(above / each).resolve() for each in folders]
        if target == above or any(map(target.is_relative_to, own)):
            raise OptionError(
                f"out={str(out)!r}: belongs to the board {above}, whose files the pages would "
                f"replace. Give another folder, such as {above / 'site'}."
            )


def _wait(pending: deque[Future[None]], left: int) -> None:
    """Wait until at most `left` writes are pending, and raise their errors."""
    while len(pending) > left:
        pending.popleft().result()
