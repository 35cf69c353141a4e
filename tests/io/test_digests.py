"""The digest of bytes, by the vectors of FIPS 180-4."""

from __future__ import annotations

import pytest

from sme_registry.io import sha256_of


@pytest.mark.parametrize(
    ("data", "digits"),
    [
        (b"", "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"),
        (b"abc", "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"),
    ],
)
def test_a_digest_is_named_by_its_algorithm(data: bytes, digits: str) -> None:
    assert sha256_of(data) == f"sha256:{digits}"
