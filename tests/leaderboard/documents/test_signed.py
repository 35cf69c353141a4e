"""Signatures: one key, one document, one purpose, one board, one address."""

import hashlib
import itertools

from leaderboard.documents.signed import Receiver, SigningKey, verifies

DIGEST, BOARD, OTHER = "sha256:" + "1" * 64, "a" * 64, "b" * 64
P = 2**255 - 19
L = 2**252 + 27742317777372353535851937790883648493
D = -121665 * pow(121666, -1, P) % P


def add(one, other):
    """The sum of two points of edwards25519 (RFC 8032, section 5.1.4, in affine coordinates)."""
    (x1, y1), (x2, y2) = one, other
    product = D * x1 * x2 * y1 * y2
    x = (x1 * y2 + x2 * y1) * pow(1 + product, -1, P)
    y = (y1 * y2 + x1 * x2) * pow(1 - product, -1, P)
    return x % P, y % P


def decode(key):
    number = int.from_bytes(key, "little")
    y, sign = number % 2**255, number >> 255
    square = (y * y - 1) * pow(D * y * y + 1, -1, P) % P
    x = pow(square, (P + 3) // 8, P)
    if (x * x - square) % P:
        x = x * pow(2, (P - 1) // 4, P) % P
    return (x if x % 2 == sign else P - x), y


def encode(point):
    x, y = point
    return (y | (x % 2) << 255).to_bytes(32, "little").hex()


def small_order_points():
    """The eight points whose order divides 8: multiples of a point of order 8."""
    generator = decode(
        bytes.fromhex("26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05")
    )
    points = list(itertools.accumulate([generator] * 8, add))
    assert points[-1] == (0, 1)
    assert len(set(points)) == 8
    return points


def small_order_keys():
    """Every encoding of them, those included that are not reduced modulo p."""
    keys = []
    for x, y in small_order_points():
        for high, sign in itertools.product((y, y + P), (0, 1)):
            if high < 2**255 and (sign == x % 2 or x == 0):
                keys.append((high | sign << 255).to_bytes(32, "little").hex())
    assert len(keys) == len(set(keys)) >= 12
    return keys


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
    zero = "0" * 64
    signatures = [encode(point) + zero for point in small_order_points()]
    digests = [f"sha256:{number:064x}" for number in range(8)]
    for case in itertools.product(small_order_keys(), signatures, digests):
        public, signature, digest = case
        assert not verifies(public, signature, "submission", digest, Receiver(BOARD)), case


def test_a_key_with_a_part_of_small_order_signs_nothing():
    """A + T, with T of order 2: S·B = R + h·(A + T) wherever h is even, so a rule of its own."""
    from nacl.bindings import crypto_scalarmult_ed25519_base_noclamp as times_base

    a, r = 3**150 % L, 5**100 % L
    A, R = (times_base(each.to_bytes(32, "little")) for each in (a, r))
    mixed = encode(add(decode(A), (0, P - 1)))
    for public, expected in ((A.hex(), True), (mixed, False)):
        for number in range(16):
            digest = f"sha256:{number:064x}"
            message = f"sme-leaderboard/submission/{BOARD}/{digest}".encode()
            hashed = hashlib.sha512(R + bytes.fromhex(public) + message).digest()
            h = int.from_bytes(hashed, "little") % L
            signature = R + ((r + h * a) % L).to_bytes(32, "little")
            if h % 2 == 0:
                assert (
                    verifies(public, signature.hex(), "submission", digest, Receiver(BOARD))
                    == expected
                )


def test_what_is_no_key_signs_nothing():
    for public in ("", "0" * 64, "f" * 64, "x" * 64, "0" * 63):
        assert not verifies(public, "0" * 128, "submission", DIGEST, Receiver(BOARD))
