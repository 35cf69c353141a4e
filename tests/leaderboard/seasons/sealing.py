"""Seasons so small that scoring takes a moment."""

import datetime

from leaderboard.documents.signed import Receiver
from leaderboard.documents.submission import now, utc
from leaderboard.scoring.ranking import failed_run
from leaderboard.scoring.verify import Findings
from leaderboard.seasons.publication import verify_seasons
from leaderboard.seasons.scoring import sealed_result
from leaderboard.seasons.season import Entry, Master, Season, Stepping, TicketRequest
from sme_registry import EvaluationProtocol

MASTER = Master(bytes(range(32)))
SETTING = {"state_dim": 2, "action_dim": 1, "complexity": 5, "hidden_width": 8}


def moment(days):
    """The time so many days from now."""
    return utc(datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days))


OPENS, CLOSES = moment(-1), moment(1)  # the same in every document of a run


def tiny_terms(track="sealed-offline", instances=2, **fields):
    """An open season of one class, without a master, and offline with digests of nothing."""
    online = track == "sealed-online"
    member = {"name": "deep", "setting": SETTING, "instances": instances}
    member |= {"budget": 64} if online else {"data": {"nu": 0.5, "transitions": 300}}
    published = [
        {"class_name": "deep", "instance": i, "data": NOTHING, "challenge": NOTHING}
        for i in range(instances)
    ]
    return Season.from_dict(
        {
            "id": track,
            "title": "Tiny",
            "track": track,
            "classes": [member],
            "opens": OPENS,
            "closes": CLOSES,
            "protocol_name": "quick-v1",
            "protocol": EvaluationProtocol(states_per_region=50).to_dict(),
            "ticket_hours": 24 if online else None,
            "tickets": 100 if online else None,
            "tickets_per_key": 2 if online else None,
            "published": [] if online else published,
            "commitment": NOTHING,
            **fields,
        }
    )


NOTHING = "sha256:" + "0" * 64


def tiny_season(track="sealed-offline", **fields):
    """`tiny_terms`, committed to `MASTER`."""
    return tiny_terms(track, **fields).commit(MASTER)


def manifest(season, key, **fields):
    """What entries and requests have in common."""
    return {
        "season": season.digest,
        "method": {"name": "Test", "version": "1", "family": "test", "knowledge": "generic"},
        "submitter": {"name": f"Tester {key.public[:8]}", "key": key.public},
        "created": now(),
        **fields,
    }


NO_STEP = Stepping(steps=0, normalised_online_regret=1.0, learning_curve=(1.0,))


def failed_result(season, subject, stepping=NO_STEP):
    """The result of an entry or a ticket of which every run failed."""
    runs = [failed_run(season.protocol, each.member.name, None) for each in season.hidden]
    steps = [stepping] * len(runs) if season.track == "sealed-online" else []
    return sealed_result(season, subject, runs, {"synthetic": "1"}, 100, steps)


def signed_entry(store, season, key, answers, **fields):
    """An entry for a board, of answers that need not be on it."""
    plain = manifest(season, key, answers=answers, **fields)
    return Entry.from_dict(plain).signed(key, Receiver(store.document.key))


def signed_request(store, season, key, nonce=0, **fields):
    """A request for a ticket of a board."""
    names = {"nonce": f"{nonce:064x}", "answers_key": key.of_answers(f"{nonce:064x}").public}
    names["transcript"] = 1
    plain = manifest(season, key, **{**names, **fields})
    return TicketRequest.from_dict(plain).signed(key, Receiver(store.document.key))


def findings_of(store, published=()):
    """What `verify` finds of the seasons."""
    findings = Findings(lambda what: None)
    verify_seasons(store, findings, published)
    return findings


def replayed(store, published=()):
    """Of one season: counts by what was checked, and notes."""
    findings = findings_of(store, published)
    counts = {row.what.partition(": ")[2]: (row.checked, row.unchecked) for row in findings.rows}
    return counts, findings.notes
