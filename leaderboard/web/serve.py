"""`serve`: the application under uvicorn, on one address, until it is interrupted."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import os
import re
import signal
import socket
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, cast

from leaderboard.errors import BoardError
from sme_registry.errors import OptionError
from sme_registry.io import require_packages

if TYPE_CHECKING:
    import uvicorn
    from fastapi import FastAPI

    from leaderboard.web.connections import Connections

_BACKLOG = 128  # connections accepted at a time, and so above the slots for a moment
_SOCKET_BYTES = 2**17  # of a connection's buffer in the system, for each direction
_OTHER_FILES = 256  # open ones that belong to no connection
# Its characters need no quotes in the commands that the pages show.
_PUBLIC_URL = re.compile(r"https?://([\w.-]+|\[[\da-fA-F:]+\])(:\d{1,5})?(/[\w.~-]+)*/?", re.ASCII)


def serve(
    path: str | os.PathLike[str],
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    announce: Callable[[str], None] = print,
    url: str = "",
    trusted_proxies: Iterable[str] = (),
    unsafe_no_sandbox: bool = False,
    season_secrets: Iterable[str | os.PathLike[str]] = (),
) -> None:
    """Serve a board and run its scorers until Ctrl-C or SIGTERM, which both end it cleanly.

    Call it in the main thread, where signals arrive.

    Args:
      path: the board's folder.
      host: address to listen on; put an HTTPS proxy in front of any but the loopback, as in
        docs/guides/deployment.md.
      port: 0 for any free port.
      workers: number of scorer processes; 0 for none.
      announce: called with the board's URL once it listens.
      url: the board's public address, such as that of its proxy, which its pages show; empty if it
        is not known.
      trusted_proxies: addresses or networks of reverse proxies. Their `X-Forwarded-For` names the
        client, which counts for the limit on requests by address, and they may open any number of
        connections. From anyone else the header is ignored.
      unsafe_no_sandbox: score without bubblewrap. Submitted policies could then read the files of
        this account and use the network, so nobody else may be able to submit. Not with the master
        of a season, which is one of these files.
      season_secrets: the files of the masters of the sealed-online seasons that are stepped.

    Raises:
      BoardError: the folder holds no board, the address cannot be used, bubblewrap, which the
        scorers need, does not work, or a master is of no season of the board.
      OptionError: the public address, or that of a proxy, is invalid, or scoring without bubblewrap
        would let policies read the master of a season.
      MissingDependencyError: FastAPI or uvicorn is not installed.
    """
    if url and not _PUBLIC_URL.fullmatch(url):
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Give the address at which "
            "others reach the board."
        )
    secrets = list(season_secrets)
    if unsafe_no_sandbox and workers and secrets:
        raise OptionError(
            "unsafe_no_sandbox=True: must be False with season_secrets, which submitted policies "
            "could read. Install bubblewrap, or score no submissions (--workers 0)."
        )
    require_packages("serving a board", {"fastapi": "FastAPI", "uvicorn": "uvicorn"}, "leaderboard")
    import uvicorn

    from leaderboard.web.app import create_app
    from leaderboard.web.connections import ConnectionLimits, Connections

    proxies = [_network(each) for each in trusted_proxies]
    limits = ConnectionLimits(connections=_connections())
    app = create_app(
        path,
        score_workers=workers,
        url=url.rstrip("/"),
        isolation="process" if unsafe_no_sandbox else "bwrap",
        season_secrets=secrets,
    )
    config = server_config(app, Connections(limits, proxies))
    with listen(host, port) as listener:
        announce(url_of(listener))
        # Uvicorn shuts down on both signals, then raises the one it received.
        previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn.Server(config).run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, previous)


def server_config(app: FastAPI, connections: Connections) -> uvicorn.Config:
    """How uvicorn serves a board."""
    import uvicorn

    proxies = [str(network) for network in connections.proxies]
    connections.take_steps = app.state.take_steps
    return uvicorn.Config(
        app,
        loop="asyncio",
        http=cast("type[asyncio.Protocol]", connections.protocol),
        ws="none",
        backlog=_BACKLOG,
        log_level="error",  # a client's faults are not the server's
        server_header=False,
        proxy_headers=bool(proxies),
        forwarded_allow_ips=proxies,
        timeout_graceful_shutdown=5,
    )


def _connections() -> int:
    """The most connections for which this process has files; it raises its limit on them.

    A connection has a socket and an artefact's file.
    """
    import resource  # Windows, where boards are not served, has none

    from leaderboard.web.connections import ConnectionLimits

    most = ConnectionLimits().connections
    wanted = 2 * (most + _BACKLOG) + _OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    files = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
    if soft < files:
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    return max(1, min(most, (files - _OTHER_FILES) // 2 - _BACKLOG))


def _network(text: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        return ipaddress.ip_network(text)
    except ValueError:
        raise OptionError(
            f"trusted_proxies={text!r:.80}: must be an IP address or network, as in 127.0.0.1 or "
            "10.0.0.0/8. Give the address from which the proxy connects."
        ) from None


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address.

    Raises:
      BoardError: the address is invalid or in use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BoardError(
            f"host={host!r}, port={port}: cannot listen here: {reason}. Use another --port."
        ) from None
    for buffer in (socket.SO_RCVBUF, socket.SO_SNDBUF):  # every connection inherits them
        listener.setsockopt(socket.SOL_SOCKET, buffer, _SOCKET_BYTES)
    # Asyncio does not, where it is given a socket: head and body of an answer were 40 ms apart.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def url_of(listener: socket.socket) -> str:
    """The URL of a listening socket."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
