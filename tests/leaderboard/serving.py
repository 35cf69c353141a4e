"""A real server on the loopback, in a thread or a process of its own."""

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import uvicorn

from leaderboard.intake import upload_header
from leaderboard.web.app import create_app
from leaderboard.web.connections import Connections
from leaderboard.web.serve import listen, server_config, url_of

# The server's five seconds to end become sixty, of which slow clients get 0.2: load logs no error.
_SERVE = """
import sys
import uvicorn
from leaderboard.web import connections
from leaderboard.web.serve import serve
connections._ENDING_SECONDS = 0.2
Config = uvicorn.Config
uvicorn.Config = lambda *given, **named: Config(*given, **named | {"timeout_graceful_shutdown": 60})
serve(sys.argv[1], port=0, workers=int(sys.argv[2]), announce=lambda url: print(url, flush=True))
"""


@contextlib.contextmanager
def serving(path, connections=None, host="127.0.0.1", **options):
    """A server in a thread; yields its URL."""
    with listen(host, 0) as listener:
        app = create_app(path, **options)
        if connections is None:
            connections = Connections()
        server = uvicorn.Server(server_config(app, connections))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            yield url_of(listener)
        finally:
            server.should_exit = True
            thread.join(10)
            assert not thread.is_alive()


def authorization(url, key, digest, time=None):
    """The header that lets a key upload an object to the board at this address."""
    board = httpx.get(f"{url}/definition.json", trust_env=False).json()["key"]
    return upload_header(key, digest, time, board=board)


@contextlib.contextmanager
def serving_process(path, workers=0):
    """A server in a process, as `serve` runs it; yields its URL and the process."""
    root = Path(__file__).parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", _SERVE, str(path), str(workers)],
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
