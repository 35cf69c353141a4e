"""What is sent to a server, and what comes from it: checked addresses, and text for a terminal."""

from __future__ import annotations

import ipaddress
from typing import NamedTuple
from urllib.parse import urlsplit

from sme_registry.errors import OptionError


class Address(NamedTuple):
    """Where a server is reached.

    Attributes:
      url: without a final slash.
      is_https: whether what is sent is encrypted.
      host, port: without brackets; None is the usual port.
      path: of the URL, without a final slash; often empty.
    """

    url: str
    is_https: bool
    host: str
    port: int | None
    path: str

    @property
    def is_local(self) -> bool:
        """Whether it is on this machine, which is reached without a proxy or encryption."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def server_address(url: str, *, insecure: bool = False) -> Address:
    """The address in a URL.

    Args:
      url: http(s)://host[:port][/path].
      insecure: allow plain http to other machines.

    Raises:
      OptionError: of another form, or plain http to another machine.
    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    others = parts.username, parts.password, parts.query, parts.fragment
    is_plain = not any(others) and url.isprintable() and " " not in url
    if parts.scheme not in ("http", "https") or not parts.hostname or not is_plain:
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Copy it from the board's page."
        )
    address = Address(
        f"{parts.scheme}://{parts.netloc}{parts.path}".rstrip("/"),
        parts.scheme == "https",
        parts.hostname,
        port,
        parts.path.rstrip("/"),
    )
    if not (address.is_https or address.is_local or insecure):
        raise OptionError(
            f"url={url!r:.80}: must be https for another machine. "
            "Use https, or a tunnel to the board."
        )
    return address


def printable(text: object) -> str:
    """A server's text for a terminal: at most 2,000 characters, without control characters."""
    return "".join(each if each.isprintable() else " " for each in str(text)[:2000])
