"""Checks of arguments, with one form of message: name, value, allowed values, remedy."""

from __future__ import annotations

import ipaddress
import math
import operator
import re
from collections.abc import Collection
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from sme_registry.errors import OptionError, SMEError, did_you_mean


def integer_in(
    name: str,
    value: Any,
    low: int,
    high: int | None = None,
    *,
    advice: str = "",
) -> int:
    """Check an integer argument. NumPy's integers count, booleans and floats do not."""
    try:
        number = None if type(value).__name__ in ("bool", "bool_") else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < low or (high is not None and number > high):
        allowed = f"of at least {low:,}" if high is None else f"in [{low:,}, {high:,}]"
        advice = advice and f" {advice}"
        raise OptionError(f"{name}={value!r:.60}: must be an integer {allowed}.{advice}")
    return number


def number_in(name: str, value: Any, low: float, high: float = math.inf) -> float:
    """Check a finite number, as `integer_in` checks an integer; booleans do not count."""
    is_number = isinstance(value, int | float | np.number) and type(value).__name__ != "bool"
    if not is_number or not (math.isfinite(value) and low <= value <= high):
        allowed = f"of at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        raise OptionError(f"{name}={value!r:.60}: must be a finite number {allowed}.")
    return float(value)


def choice(
    name: str, value: Any, allowed: Collection[str], *, error: type[SMEError] = OptionError
) -> str:
    """Check that an argument is one of a few allowed names, and return it."""
    if isinstance(value, str) and value in allowed:
        return value
    *others, last = map(repr, allowed)
    names = f"{', '.join(others)} or {last}" if others else last
    near = did_you_mean(value, allowed) if isinstance(value, str) else ""
    raise error(f"{name}={value!r:.60}: must be {names}.{near}")


class Address(NamedTuple):
    """Where a server is reached; `path` ends in no slash."""

    url: str  # the same text for each way to write the address
    is_https: bool
    host: str  # without brackets
    port: int | None  # None is the usual one
    path: str

    @property
    def is_local(self) -> bool:
        """Whether it is on this machine, which is reached without a proxy or encryption."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def server_address(url: str, *, insecure: bool = False) -> Address:
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
    host, path = parts.hostname, parts.path.rstrip("/")
    name = "127.0.0.1" if host == "localhost" else f"[{host}]" if ":" in host else host
    usual = {"http": 80, "https": 443}[parts.scheme]
    place = name if port in (None, usual) else f"{name}:{port}"
    address = Address(f"{parts.scheme}://{place}{path}", parts.scheme == "https", host, port, path)
    if not (address.is_https or address.is_local or insecure):
        raise OptionError(
            f"url={url!r:.80}: must be https for another machine. "
            "Use https, or a tunnel to the board."
        )
    return address


# Letters that take no ink or no width, and which Python calls printable.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0"
    "\U0001d173-\U0001d17a\U000e0100-\U000e01ef]"
)


def hidden_in(text: str) -> set[str]:
    """The characters of a text that a terminal obeys or does not show, but for line breaks.

    They are control characters, marks of direction, and letters without ink or width.
    """
    if text.isascii() and text.isprintable():
        return set()
    hidden = {letter for letter in text if not letter.isprintable()} - {"\n"}
    return hidden.union(_INVISIBLE.findall(text))


def visible(text: str) -> str:
    """A text with hidden characters as escapes, such as `\\x1b` and `\\u202e`."""
    escapes = {ord(each): each.encode("unicode_escape").decode() for each in hidden_in(text)}
    return text.translate(escapes)
