"""Seasons: terms that fit their track, a commitment to the secret, secrets that do not collide."""

import hashlib
import itertools
from typing import get_args

import pytest
import rfc8785

from leaderboard.errors import BoardError
from leaderboard.seasons.season import Master, Place, Purpose, Reveal, Season
from sme_registry import SMESpec
from sme_registry.errors import SpecError
from tests.leaderboard.seasons.sealing import MASTER, OPENS, SETTING, moment, tiny_terms

PURPOSES = get_args(Purpose)


def online(**fields):
    return {**tiny_terms("sealed-online").to_dict(), **fields}


def offline(**fields):
    return {**tiny_terms().to_dict(), **fields}


@pytest.mark.parametrize("track", [online, offline])
def test_a_season_is_committed_to_its_master_and_to_every_term(track):
    season = Season.from_dict(track(versions={"numpy": "2.0.0"})).commit(MASTER)
    terms = season.to_dict()
    del terms["commitment"]
    message = b"sme-seal/1" + MASTER.raw + rfc8785.dumps(terms)
    assert season.commitment == "sha256:" + hashlib.sha256(message).hexdigest()
    assert Season.from_dict(season.to_dict()) == season
    assert set(terms) == set(Season.model_fields) - {"admission", "commitment"}
    assert repr(terms["ticket_hours"]) in ("24", "None")  # as in earlier files
    assert season.is_committed_to(MASTER)
    assert not season.is_committed_to(Master(bytes(32)))
    last = "1" if season.commitment[-1] == "0" else "0"
    for name, value in (
        ("closes", moment(2)),
        ("commitment", season.commitment[:-1] + last),
    ):
        assert not Season.from_dict({**season.to_dict(), name: value}).is_committed_to(MASTER)


def test_every_purpose_and_place_has_a_secret_of_its_own():
    places = [
        Place(*parts)
        for parts in itertools.product(
            ("a", "b"), ("a", "ab"), (0, 1, 10), ("", "1", "b"), ("", "2", "b2")
        )
    ]
    drawn = {MASTER.secret(purpose, place) for purpose in PURPOSES for place in places}
    assert len(drawn) == len(PURPOSES) * len(places)
    assert MASTER.secret("task", places[0]) != Master(bytes(32)).secret("task", places[0])


def test_a_seed_has_256_bits_and_makes_a_spec():
    places = [Place("autumn", "deep", i) for i in range(64)]
    for purpose in ("task", "data"):  # a seed of hidden data could be tried out, too
        seeds = [MASTER.seed(place, purpose) for place in places]
        assert max(int(seed, 16).bit_length() for seed in seeds) > 250
    assert seeds[0] != MASTER.seed(places[0])
    seed = MASTER.seed(places[0])
    assert SMESpec.from_dict({**SETTING, "seed": seed}).seed == seed
    assert 0 <= MASTER.states_seed(places[0]) < 2**53


def test_the_seed_of_published_states_has_no_bits_of_another_secret():
    place = Place("autumn", "deep", 0)
    first = {each: int.from_bytes(MASTER.secret(each, place)[:8]) >> 11 for each in PURPOSES}
    assert {each for each in PURPOSES if first[each] == MASTER.states_seed(place)} == {"states"}


def test_a_file_without_a_master_is_named(tmp_path):
    path = tmp_path / "season.master"
    for content in ("", "00", "z" * 64, "0" * 66):
        path.write_text(content)
        with pytest.raises(BoardError, match=r"season\.master: no master secret"):
            Master.read(path)
    with pytest.raises(BoardError, match="no master secret"):
        Master.read(tmp_path / "missing")


def online_class(**fields):
    """A season online whose class has other fields."""
    return online(classes=[{**online()["classes"][0], **fields}])


def test_a_reveal_has_32_bytes():
    digest = Season.from_dict(online()).commit(MASTER).digest
    for master in ("0" * 63, "G" * 64):
        with pytest.raises(SpecError, match="64 hex digits"):
            Reveal.from_dict({"season": digest, "master": master})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (online_class(setting={"complexity": 4}), "at least 5"),
        (
            online_class(setting={"complexity": 5, "safety": {"tightness": 0.2}}),
            "safety: must be null",
        ),
        (online(classes=online()["classes"] * 2), "different names"),
        (online_class(instances=1001), "1000"),
        (online_class(budget=None), r"budget: must be given"),
        (online_class(data={"nu": 0.5, "transitions": 9}), r"deep\.data: must be null"),
        # A data set of the optimum itself.
        (
            offline(classes=[offline()["classes"][0] | {"data": {"nu": 0, "transitions": 100}}]),
            r"data\.nu",
        ),
        (online(ticket_hours=None), "ticket_hours: must be given"),
        (online(ticket_hours=0.0), "ticket_hours=0.0: must be"),
        (offline() | {"tickets": 3}, "tickets: must be null"),
        (offline() | {"published": offline()["published"][::-1]}, "published: must list every"),
        (online(closes=OPENS), "must be after opens"),
        (online(opens="2025-02-30T00:00:00Z"), "2025-02-30T00:00:00Z: is no date"),
        (online(protocol={"seed": 1}), "seed=1: must be 0"),
    ],
)
def test_terms_that_do_not_fit_are_refused(fields, message):
    with pytest.raises(SpecError, match=message):
        Season.from_dict(fields)
