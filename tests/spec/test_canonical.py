"""The canonicaliser behind every digest, against the vectors that RFC 8785's author publishes."""

import hashlib
import json
import struct
from pathlib import Path

import pytest
import rfc8785

from sme_registry.io import parse_json
from sme_registry.spec import SMESpec

VECTORS = Path(__file__).parent / "rfc8785"
NAMES = sorted(path.stem for path in (VECTORS / "input").glob("*.json"))
NUMBERS = [line.split() for line in (VECTORS / "numbers.txt").read_text().splitlines()]


def number(bits: str) -> float:
    return struct.unpack(">d", bytes.fromhex(bits))[0]


def test_published_documents_have_their_published_canonical_bytes():
    assert NAMES == ["arrays", "french", "structures", "unicode", "values", "weird"]
    for name in NAMES:
        given = (VECTORS / "input" / f"{name}.json").read_bytes()
        expected = (VECTORS / "output" / f"{name}.json").read_bytes()
        assert rfc8785.dumps(parse_json(given)) == expected


def test_the_example_in_the_standard_has_its_printed_bytes():
    given = parse_json((VECTORS / "sample.json").read_bytes())
    assert rfc8785.dumps(given) == bytes.fromhex((VECTORS / "sample.hex").read_text())


def test_published_numbers_have_their_published_form():
    assert len(NUMBERS) == 26
    for bits, text in NUMBERS:
        if text == "error":  # not finite
            with pytest.raises(rfc8785.FloatDomainError):
                rfc8785.dumps(number(bits))
        else:
            assert rfc8785.dumps(number(bits)) == text.encode()


def test_the_digest_is_the_hash_of_every_field_in_canonical_form():
    text = (
        '{"D":0,"action_dim":4,"complexity":1,"hidden_width":64,"horizon":100,"k":1,'
        '"policy_init":"semi_orthogonal","r_min":0,"schema_version":1,"seed":0,"state_dim":8,'
        '"team":null}'
    )
    assert SMESpec().canonical_json() == text.encode()
    assert SMESpec().digest == "sha256:" + hashlib.sha256(text.encode()).hexdigest()
    assert json.loads(text) == SMESpec().to_dict()
