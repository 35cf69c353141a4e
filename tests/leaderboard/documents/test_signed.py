"""Signatures: one key, one document, one purpose, one board, one address."""

import itertools

from leaderboard.documents.signed import Receiver, SigningKey, verifies

DIGEST, BOARD, OTHER = "sha256:" + "1" * 64, "a" * 64, "b" * 64
SMALL_ORDER = [
    "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05",
    "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a",
    *("00" * 32, "01" + "00" * 31),
    *(f"{first}{'ff' * 30}7f" for first in ("ec", "ed", "ee")),
]
"""Every y of a point whose order divides 8, also where it is not reduced modulo 2²⁵⁵ − 19."""


def test_a_signature_is_for_one_document_purpose_board_and_address():
    key, here = SigningKey.generate(), Receiver(BOARD, "https://board.example")
    receivers = (
        *(Receiver(), Receiver(BOARD), Receiver(OTHER), here),
        *(Receiver(OTHER, here.address), Receiver(BOARD, "https://board.example/sme")),
    )
    uses = list(itertools.product(("submission", "withdrawal", "upload", "log"), receivers))
    for signed, checked in itertools.product(uses, repeat=2):
        signature = key.sign(signed[0], DIGEST, signed[1])
        assert verifies(key.public, signature, checked[0], DIGEST, checked[1]) == (
            signed == checked
        )
    signature = key.sign("submission", DIGEST, here)
    assert not verifies(key.public, signature, "submission", "sha256:" + "2" * 64, here)
    assert not verifies(SigningKey.generate().public, signature, "submission", DIGEST, here)


def test_keys_of_small_order_sign_nothing():
    """With such a key, R = S·B and R + h·A agree for every document whose h is a multiple of 8."""
    points = [bytes.fromhex(each) for each in SMALL_ORDER]
    keys = [(point[:-1] + bytes([point[-1] | x])).hex() for point in points for x in (0, 0x80)]
    signatures = [key + "0" * 64 for key in keys]
    digests = [f"sha256:{number:064x}" for number in range(8)]
    for case in itertools.product(keys, signatures, digests):
        public, signature, digest = case
        assert not verifies(public, signature, "submission", digest, Receiver(BOARD)), case


def test_a_key_with_a_part_of_small_order_signs_nothing():
    """A + T, with T of order 2: S·B = R + h·(A + T) wherever h is even, so a rule of its own."""
    R = "9342ca62a3ec58d5bee432c55c0c39a434338468c52c697b49f24db76a5f8262"
    for public, number, S, expected in (
        (
            *("2e53fc2a791e809894bfd4c80f0ced36b73fad1f1c313cea91babf57c70d3f27", 0),
            *("430a5ddc2e963545a7b1c502faa74486dccf88012013817a52cbad69438b750d", True),
        ),
        (
            *("bfac03d586e17f676b402b37f0f312c948c052e0e3cec3156e4540a838f2c0d8", 1),
            *("8a39a6b25256c9355cf0a2612e6f8a3b856f754eac87d486d450fcc5f90ee809", False),
        ),
    ):
        digest = f"sha256:{number:064x}"
        assert verifies(public, R + S, "submission", digest, Receiver(BOARD)) == expected


def test_what_is_no_key_signs_nothing():
    for public in ("", "0" * 64, "f" * 64, "x" * 64, "0" * 63):
        assert not verifies(public, "0" * 128, "submission", DIGEST, Receiver(BOARD))
