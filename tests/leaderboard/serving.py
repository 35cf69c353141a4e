"""A real server on the loopback, in a thread or a process of its own."""

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import uvicorn

from leaderboard.admission import upload_header
from leaderboard.documents.signed import Receiver
from leaderboard.web.app import create_app
from leaderboard.web.server import config_of, listen, url_of

# The server's five seconds to end become sixty: load logs no error.
_SERVE = """
import sys
import uvicorn
from pathlib import Path
from leaderboard.cli.admin import serve
Config = uvicorn.Config
uvicorn.Config = lambda *given, **named: Config(*given, **named | {"timeout_graceful_shutdown": 60})
board, workers, port, *secrets = sys.argv[1:]
serve(Path(board), port=int(port), workers=int(workers), season_secret=list(map(Path, secrets)))
"""


@contextlib.contextmanager
def serving(path, seen=None, **options):
    """A server in a thread; yields its URL. A list `seen` gets the application's requests."""
    with listen("127.0.0.1", 0) as listener:
        app = create_app(path, options.pop("url", url_of(listener)), **options)
        if seen is not None:
            app.add_middleware(_Seen, seen=seen)
        server = uvicorn.Server(config_of(app))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            yield url_of(listener)
        finally:
            server.should_exit = True
            thread.join(60)
            assert not thread.is_alive()


class _Seen:
    """ASGI middleware that adds the path of each request to a list, and removes it at its end."""

    def __init__(self, app, seen):
        self._app, self._seen = app, seen

    async def __call__(self, scope, receive, send):
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        self._seen.append(scope["path"])
        try:
            await self._app(scope, receive, send)
        finally:
            self._seen.remove(scope["path"])


def authorization(url, key, digest, time=None):
    """The header that lets a key upload an object to the board at this address."""
    return upload_header(key, digest, receiver(url), time)


def receiver(url, address=None):
    """For whom to sign what is sent to a board, by default at the address where it is reached."""
    board = httpx.get(f"{url}/definition.json", trust_env=False).json()["key"]
    return Receiver(board, address or url)


def alive(pid):
    """Whether a process has this id and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextlib.contextmanager
def serving_process(path, workers=0, port=0, secrets=()):
    """A server in a process, as `serve` runs it; yields its URL and the process."""
    root = Path(__file__).parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", _SERVE, *map(str, (path, workers, port, *secrets))],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        url = process.stdout.readline().strip()
        assert url, process.stderr.read()
        yield url, process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()
