"""Checks of arguments and addresses, and the versions that documents record."""

import ast
import math
import platform
import sys

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import OptionError
from sme_registry.io import choice, integer_in, number_in, server_address, versions, visible


def test_an_integer_or_a_number_in_its_range_comes_back_as_pythons():
    for value in (1, 7, np.int64(3), np.uint8(1)):
        assert type(integer_in("jobs", value, 1, 7)) is int
    for value in (0, 1, 0.25, np.float32(0.5), np.int64(1)):
        assert type(number_in("cost_limit", value, 0.0, 1.0)) is float
    assert integer_in("seed", 2**70, 0) == 2**70
    assert number_in("multiplier", 1e9, 0.0) == 1e9


@pytest.mark.parametrize(
    ("check", "low", "high", "allowed", "values"),
    [
        (integer_in, 1, 7, "an integer in [1, 7]", [0, 8, 1.0, np.ones(2, int)]),
        (integer_in, 0, None, "an integer of at least 0", [-1, 1.0]),
        (number_in, 0.0, 1.0, "a finite number in [0, 1]", [-0.1, 1.5, np.nan, np.inf]),
        (number_in, 0.0, math.inf, "a finite number of at least 0", [-1, np.inf]),
    ],
)
def test_any_other_value_is_refused_with_name_value_and_range(check, low, high, allowed, values):
    for value in (*values, True, np.bool_(1), np.float64(-1.7), "3", None):
        with pytest.raises(OptionError) as caught:
            check("x", value, low, high)
        shown = value.item() if isinstance(value, np.generic) else value
        assert str(caught.value) == f"x={shown!r}: must be {allowed}."
    with pytest.raises(OptionError, match=r"^seed=-1: must be an integer of at least 0\. Leave"):
        integer_in("seed", -1, 0, advice="Leave it out.")


def test_a_choice_is_one_of_the_names_and_a_near_miss_is_suggested():
    assert choice("action_range", "unit", ("unit", "symmetric")) == "unit"
    with pytest.raises(OptionError) as caught:
        choice("action_range", "symetric", ("unit", "symmetric"))
    assert str(caught.value) == (
        "action_range='symetric': must be 'unit' or 'symmetric'. Did you mean 'symmetric'?"
    )
    for value in (None, 1, ["unit"]):
        with pytest.raises(OptionError, match="must be 'unit' or 'symmetric'"):
            choice("action_range", value, ("unit", "symmetric"))


def test_versions_are_of_what_is_installed():
    assert versions(["numpy", "no-such-package", ""], if_imported=["scipy", "antigravity"]) == {
        "sme_registry": sme_registry.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        **({"scipy": versions(["scipy"])["scipy"]} if "scipy" in sys.modules else {}),
    }


@pytest.mark.parametrize(
    "url",
    [
        "",
        "board",
        "http://127.0.0.1:99999",
        "http://user:word@127.0.0.1",
        "http://127.0.0.1/a board",
        "http://127.0.0.1/\n",
        "https://board.example/?next=1",
        "http://localhost.example",
    ],
)
def test_an_invalid_url_is_rejected(url):
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
def test_plain_http_is_for_this_machine(url, host, port, path, local):
    address = server_address(url)
    assert (address.host, address.port, address.path) == (host, port, path)
    assert address.url == url.rstrip("/").replace("localhost", "127.0.0.1")
    assert address.is_local == local
    far = server_address("http://board.example:8000", insecure=True)
    assert (far.is_https, far.is_local) == (False, False)


def test_hidden_characters_are_shown_as_escapes():
    assert visible("é r̃ ½ 名\n") == "é r̃ ½ 名\n"
    controls, marks = "\0\x07\x1b\r\t\x7f\x9b", "\u061c\u200b\u200d\u202e\u2069\ufeff\ufe0f"
    for hidden in f"{controls}{marks}\u00a0\u00ad\u2800\u3164":
        shown = visible(f"a{hidden}b")
        assert shown.isascii()
        assert shown.isprintable()
        assert ast.literal_eval(f'"{shown}"') == f"a{hidden}b"
    assert visible("\ud800\U000e0001") == r"\ud800\U000e0001"
