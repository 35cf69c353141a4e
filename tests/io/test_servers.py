"""Addresses of servers, and what they send for a terminal."""

from __future__ import annotations

import pytest

from sme_registry.errors import OptionError
from sme_registry.io import printable, server_address


@pytest.mark.parametrize(
    "url",
    [
        "",
        "board",
        "file:///etc/passwd",
        "http://",
        "http://127.0.0.1:99999",
        "http://user:word@127.0.0.1",
        "http://127.0.0.1/a board",
        "http://127.0.0.1/\n",
        "https://board.example/?next=1",
        "https://board.example/#top",
        "http://10.0.0.1:8000",
        "http://localhost.example",
    ],
)
def test_an_invalid_url_is_rejected(url: str) -> None:
    with pytest.raises(OptionError, match="url="):
        server_address(url)


@pytest.mark.parametrize(
    ("url", "host", "port", "path", "local"),
    [
        ("http://127.0.0.1:8000/", "127.0.0.1", 8000, "", True),
        ("http://[::1]:8000", "::1", 8000, "", True),
        ("http://localhost:8000/board/", "localhost", 8000, "/board", True),
        ("https://board.example/", "board.example", None, "", False),
    ],
)
def test_plain_http_is_for_this_machine(
    url: str, host: str, port: int | None, path: str, local: bool
) -> None:
    address = server_address(url)
    assert (address.host, address.port, address.path) == (host, port, path)
    assert address.url == url.rstrip("/")
    assert address.is_local == local
    far = server_address("http://board.example:8000", insecure=True)
    assert (far.is_https, far.is_local) == (False, False)


def test_a_server_s_text_has_no_control_characters() -> None:
    assert printable("a\x1b[2J\nb") == "a [2J b"
    assert len(printable("a" * 10_000)) == 2000
