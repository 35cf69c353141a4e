"""`serve`: the application under uvicorn, on one address, until it is interrupted."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
from collections.abc import Callable

from leaderboard.errors import BoardError
from sme_registry.errors import OptionError
from sme_registry.io import require_packages

_CONNECTIONS = 1000
# Its characters need no quotes in the commands that the pages show.
_PUBLIC_URL = re.compile(r"https?://([\w.-]+|\[[\da-fA-F:]+\])(:\d{1,5})?(/[\w.~-]+)*/?", re.ASCII)


def serve(
    path: str | os.PathLike[str],
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    announce: Callable[[str], None] = print,
    url: str = "",
) -> None:
    """Serve a board and run its scorers until Ctrl-C or SIGTERM, which both end it cleanly.

    Call it in the main thread, where signals arrive.

    Args:
      path: the board's folder.
      host: address to listen on; put an HTTPS proxy in front of any but the loopback.
      port: 0 for any free port.
      workers: number of scorer processes; 0 for none.
      announce: called with the board's URL once it listens.
      url: the board's public address, such as that of its proxy, which its pages show; empty if it
        is not known.

    Raises:
      BoardError: the folder holds no board, or the address cannot be used.
      OptionError: the public address is invalid.
      MissingDependencyError: FastAPI or uvicorn is not installed.
    """
    if url and not _PUBLIC_URL.fullmatch(url):
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Give the address at which "
            "others reach the board."
        )
    require_packages("serving a board", {"fastapi": "FastAPI", "uvicorn": "uvicorn"}, "leaderboard")
    import uvicorn

    from leaderboard.web.app import create_app

    config = uvicorn.Config(
        create_app(path, score_workers=workers, url=url.rstrip("/")),
        http="h11",
        ws="none",
        log_level="warning",
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=5,
    )
    with listen(host, port) as listener:
        announce(url_of(listener))
        # Uvicorn shuts down on both signals, then raises the one it received.
        previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn.Server(config).run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, previous)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address.

    Raises:
      BoardError: the address is invalid or in use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_CONNECTIONS)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BoardError(
            f"host={host!r}, port={port}: cannot listen here: {reason}. Use another --port."
        ) from None


def url_of(listener: socket.socket) -> str:
    """The URL of a listening socket."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
