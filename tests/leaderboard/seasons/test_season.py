"""An offline season from its plan to its replay: what is published, scored, ranked and verified."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.scoring.ranking import run_metrics
from leaderboard.seasons import scoring
from leaderboard.seasons.publication import (
    challenge_path,
    check_published,
    create_season,
    dataset_path,
    read_plan,
    read_season,
    recipe,
    refuse_unfit,
)
from leaderboard.seasons.scoring import (
    by_key,
    counting,
    instances,
    score_entries,
    score_runs,
    sealed_result,
    season_rankings,
)
from leaderboard.seasons.season import Master, Reveal, Season
from leaderboard.seasons.store import SeasonStore
from sme_registry import materialize
from sme_registry.datasets import SealedDataset
from sme_registry.evaluation import evaluate_many
from sme_registry.io import sha256_of
from sme_registry.seasons.wire import pack_table, unpack_table
from tests.leaderboard.conftest import ROOT, SEASONS, tiny_board
from tests.leaderboard.seasons.sealing import (
    MASTER,
    NOTHING,
    failed_result,
    moment,
    replayed,
    signed_entry,
    signed_request,
    tiny_season,
    tiny_terms,
)


def plan(**fields):
    terms = tiny_terms(**fields).to_dict()
    del terms["published"]
    return terms


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    folder = tmp_path_factory.mktemp("season") / "published"
    create_season(read_plan(plan()), MASTER, folder)
    return folder


@pytest.fixture(scope="module")
def season(published):
    return read_season(published)


def challenges(folder):
    hidden = read_season(folder).hidden
    return [unpack_table(challenge_path(folder, each).read_bytes(), 4) for each in hidden]


def enter(store, season, key, answers, **fields):
    files = [None if each is None else pack_table(each) for each in answers]
    digests = [None if each is None else sha256_of(each) for each in files]
    named = [
        None if data is None else {"sha256": digest, "size": len(data)}
        for data, digest in zip(files, digests, strict=True)
    ]
    signed = signed_entry(store, season, key, named, **fields)
    data = dict(zip(digests, files, strict=True))
    assert scoring.enter(store, signed, answers=lambda digest: data[digest] or b"")
    return signed.id


def method(name, knowledge="generic"):
    return {"name": name, "version": "1", "family": "test", "knowledge": knowledge}


def halves(folder):
    return [np.full((len(each), 1), 0.5, np.float32) for each in challenges(folder)]


def optima(season, folder):
    """What nobody but the organiser can answer."""
    tasks = [materialize(each.spec) for each in instances(season, MASTER)]
    return [
        task.optimal_action(shown[:, :2].astype(np.float64)).astype(np.float32)
        for task, shown in zip(tasks, challenges(folder), strict=True)
    ]


def reveal(store, season):
    store.reveal(Reveal(season=season.digest, master=MASTER.raw.hex()))


def false_season(store, terms):
    """A season of an organiser's own making, announced though it is over, and revealed."""
    season = terms.commit(MASTER)
    with store.transaction():
        store.record("season", season.digest, season)
    reveal(store, season)
    return season


def test_a_season_is_generated_from_its_plan_and_its_master(season, published, tmp_path):
    check_published(season, published)
    counts = []
    again = create_season(
        read_plan(plan()), MASTER, tmp_path / "again", lambda *each: counts.append(each)
    )
    assert again == season
    assert counts == [(done, len(season.published)) for done in range(1, len(counts) + 1)]
    assert len(counts) == len(season.published)
    assert season.versions["numpy"] == np.__version__
    assert {"sme_registry", "python", "scipy"} <= set(season.versions)
    other = create_season(read_plan(plan()), Master(bytes(32)), tmp_path / "other")
    mine = {(each.data, each.challenge) for each in season.published}
    assert not mine & {(each.data, each.challenge) for each in other.published}
    online = read_plan(plan(track="sealed-online"))
    assert create_season(online, MASTER, tmp_path / "online").published == ()


def test_nothing_published_tells_a_secret(season, published):
    secrets = {MASTER.raw.hex()}
    for instance in instances(season, MASTER):
        seeds = (instance.spec.seed, instance.protocol.seed, recipe(instance, MASTER).seed)
        assert len(set(seeds)) == 3
        secrets |= {str(instance.spec.seed)[2:], instance.spec.digest[7:]}
        secrets |= {str(instance.protocol.seed), instance.spec.content_name}
        secrets |= {MASTER.seed(instance.place, "data")[2:]}
    for path in published.rglob("*"):
        content = path.name.encode() + (path.read_bytes() if path.is_file() else b"")
        assert not any(secret.encode() in content for secret in secrets)
        assert MASTER.raw not in content


def test_an_altered_publication_is_named(season, published, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(published, copy)
    first, second = season.hidden
    path = challenge_path(copy, first)
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(BoardError, match=r"deep-0\.npy: has the digest"):
        check_published(season, copy)
    path.write_bytes(whole)
    target = dataset_path(copy, season.id, second)
    shutil.rmtree(target)
    shutil.copytree(dataset_path(copy, season.id, first), target)
    with pytest.raises(BoardError, match="deep-1-v0: has the digest"):
        check_published(season, copy)
    fields = season.to_dict()
    fields["classes"][0]["data"]["transitions"] = 301
    with pytest.raises(BoardError, match=r"has \(300, 4, 1\) .* must have \(301, 4, 1\)"):
        check_published(Season.from_dict(fields), published)


def test_answers_must_fit_a_board_and_somebody_must_be_able_to_have_a_rank():
    with pytest.raises(BoardError, match=r"classes\.deep: its answers have"):
        refuse_unfit(tiny_terms(), 1000, 1)
    for track, most in (("sealed-offline", 2), ("sealed-online", 4)):
        refuse_unfit(tiny_terms(track), 10_000, most)
        with pytest.raises(BoardError, match=rf"deep: a key has at most {most} runs in it: must"):
            refuse_unfit(tiny_terms(track), 10_000, most + 1)


def test_the_plan_in_the_documentation_is_one():
    page = (ROOT / "docs" / "guides" / "seasons.md").read_text()
    [text] = re.findall(r"```json\n(.*?)```", page, re.S)
    terms = read_plan(json.loads(text))
    assert len(list(terms.hidden)) == 10
    online = {**terms.to_dict(), "track": "sealed-online", "ticket_hours": 24}
    online |= {"tickets": 100, "tickets_per_key": 3}
    online["classes"][0] |= {"data": None, "budget": 1000}
    assert read_plan(online).published == ()


def test_a_season_is_scored_ranked_and_replayed(store, key, season, published, later, monkeypatch):
    store.announce(season)
    friend, best = SigningKey.generate(), optima(season, published)
    first = enter(store, season, key, best, method=method("Best"))
    last = enter(store, season, key, halves(published), method=method("Best"))
    # Kept back, and logged by an organiser's own board when a later one had arrived.
    old = {"method": method("Best"), "created": moment(-2)}
    store.add(signed_entry(store, season, key, [None, None], **old))
    enter(store, season, friend, halves(published), method=method("Fit"))
    family = enter(store, season, friend, best, method=method("Fit", "family"))
    failed = enter(store, season, friend, [None, None], method=method("Failed"))
    middle = [0.25 + 0.5 * each for each in best]  # half way from ½ to the optimum
    near = enter(store, season, friend, middle, method=method("Middle"))
    with pytest.raises(Rejection, match="season_not_closed"):
        score_entries(store, season.id)
    later()
    reveal(store, season)
    assert [row.id for row in counting(store, season)] == [last, family, failed, near]
    passes = []

    def counted(policies, *arguments):
        passes.append(len(policies))
        return evaluate_many(policies, *arguments)

    monkeypatch.setattr("leaderboard.seasons.scoring.evaluate_many", counted)
    counts = []
    assert score_entries(store, season.id, lambda *each: counts.append(each)) == 4
    assert score_entries(store, season.id) == 4
    assert counts == [(1, 4), (2, 4), (3, 4), (4, 4)]
    rankings = season_rankings(store, season, "wd_regret")
    generic, fitted = rankings["generic"], rankings["family"]
    assert [row.entry.id for row in generic] == [near, last, failed]
    assert [row.entry.id for row in fitted] == [family]
    values = [row.value.value for row in generic]
    assert values == pytest.approx([0.5, 1.0, 1.0], abs=1e-5)
    assert fitted[0].value.value == pytest.approx(0.0, abs=1e-5)
    assert fitted[0].entry.oracle_like
    assert replayed(store) == (
        {"signatures of entrants": (7, 0), "data sets": (2, 0), "results, scored again": (4, 0)},
        [],
    )
    answer = store.folder.object(sha256_of(pack_table(middle[0])))
    answer.rename(answer.with_name(".moved"))
    assert replayed(store)[0]["results, scored again"] == (3, 1)
    answer.with_name(".moved").rename(answer)
    assert passes[:4] == 2 * [3, 3]  # scored and verified, on each of two instances
    assert by_key(store, season) == {key.public: (1, 3), friend.public: (3, 4)}
    [(alone, _)] = score_runs(next(instances(season, MASTER)), [(middle[0], None)])
    row = store.entrant(near)
    assert row is not None
    together = store.sealed_result(row)
    assert together is not None
    assert together.runs[0].normalised_regret == alone.normalised_regret
    store.finish(failed_result(season, first))
    with pytest.raises(TamperedError, match=rf"entry 1 \({first}\): has a result, and does not"):
        replayed(store)


def test_a_replay_finds_scores_that_do_not_follow(store, key, season, published, later):
    """The organiser, who holds the board's key, publishes another score."""
    store.announce(season)
    enter(store, season, key, halves(published))
    later()
    reveal(store, season)
    assert replayed(store)[0]["results, scored again"] == (0, 1)
    finish = store.finish

    def better(result):
        run = result.runs[0]
        regrets = (0.5 * run.normalised_regret[0], *run.normalised_regret[1:])
        levels = (0.0, *season.protocol.epsilons)
        metrics = run_metrics(regrets, run.similarity, levels)
        lower = run.model_copy(update={"normalised_regret": regrets, **metrics})
        runs = lower, *result.runs[1:]
        return finish(sealed_result(season, result.subject, runs, result.versions, 100))

    store.finish = better
    score_entries(store, season.id)
    [note] = replayed(store)[1]
    assert note.difference.path == "runs.0.normalised_regret.0"


@pytest.mark.parametrize("part", ["data", "challenge"])
def test_a_replay_finds_a_false_publication(store, tmp_path, season, published, later, part):
    fields, copy = season.to_dict(), tmp_path / "copy"
    fields["published"][1][part] = fields["published"][0][part]
    shutil.copytree(published, copy)
    later()
    false = false_season(store, Season.from_dict(fields))
    (copy / "season.json").write_text(json.dumps(false.to_dict()))
    if part == "data":
        assert replayed(store)[0]["data sets"] == (1, 1)
        other = dataset_path(copy, false.id, list(false.hidden)[1])
        shutil.rmtree(other)
        shutil.copytree(other.with_name("deep-0-v0"), other)
    with pytest.raises(TamperedError, match="published deep 1"):
        replayed(store, [copy])


def test_the_digest_of_an_earlier_season_is_over_float64(store, season, later):
    fields = season.to_dict()
    for instance, listed in zip(instances(season, MASTER), fields["published"], strict=True):
        data = SealedDataset.collect(recipe(instance, MASTER))
        assert listed["data"] == data.rounded().digest != data.digest
        listed["data"] = data.digest
    later()
    false_season(store, Season.from_dict(fields))
    assert replayed(store)[0]["data sets"] == (2, 0)


KERNEL = """
from leaderboard.seasons.scoring import instances
from leaderboard.seasons.publication import recipe
from sme_registry.datasets import SealedDataset
from tests.leaderboard.seasons.sealing import MASTER, tiny_season

for instance in instances(tiny_season(), MASTER):
    print(SealedDataset.collect(recipe(instance, MASTER)).rounded().digest)
"""


@pytest.mark.parametrize("kernel", ["Haswell", "Prescott"])
def test_digests_do_not_depend_on_the_processor(season, kernel):
    done = subprocess.run(
        [sys.executable, "-c", KERNEL],
        env={**os.environ, "OPENBLAS_CORETYPE": kernel},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == [each.data for each in season.published], done.stderr


def test_another_machines_rounding_is_no_false_publication(store, season, published, later):
    """As if the organiser's processor had rounded rewards otherwise than this one."""
    fields = season.to_dict()
    fields["published"] = fields["published"][:1]
    fields["classes"][0]["instances"] = 1
    path = dataset_path(published, season.id, next(season.hidden))
    data = SealedDataset.read(path)
    data = dataclasses.replace(data, rewards=data.rewards + np.float32(1e-7))
    fields["published"][0]["data"] = data.digest
    later()
    false = false_season(store, Season.from_dict(fields))
    assert replayed(store)[0]["data sets"] == (0, 1)
    copy = store.season_folder(false.digest) / "published"
    shutil.copytree(published, copy)
    with pytest.raises(BoardError, match="Download it again"):
        replayed(store)
    shutil.rmtree(dataset_path(copy, season.id, next(season.hidden)))
    data.write(f"sealed/{season.id}/deep-0-v0", copy / "datasets")
    assert replayed(store)[0]["data sets, within 1e-6"] == (1, 0)


@pytest.mark.parametrize(("needed", "reason"), [(1, ""), (2, "too_few_runs")])
def test_the_class_with_the_fewest_runs_decides_on_a_rank(tmp_path, key, later, needed, reason):
    member = tiny_terms().to_dict()["classes"][0]
    names = ["one", "three", "three", "three"]
    season = tiny_season(
        classes=[{**member, "name": n, "instances": names.count(n)} for n in ("one", "three")],
        published=[
            {"class_name": name, "instance": i, "data": NOTHING, "challenge": NOTHING}
            for i, name in zip((0, 0, 1, 2), names, strict=True)
        ],
    )
    with tiny_board(tmp_path / "board", runs_to_rank=needed) as store:
        store.announce(season)
        enter(store, season, key, [None] * 4)
        later()
        reveal(store, season)
        score_entries(store, season.id)
        [row] = season_rankings(store, season, "wd_regret")["generic"]
    assert (row.reason, row.ranks) == (reason, "" if reason else "1")


@pytest.mark.parametrize(("needed", "reason"), [(4, ""), (5, "too_few_runs")])
def test_the_tickets_of_each_method_have_their_own_scores_and_rank(
    tmp_path, key, later, needed, reason
):
    season = tiny_season("sealed-online")
    with tiny_board(tmp_path / "board", runs_to_rank=needed) as store:
        store.announce(season)
        other = SigningKey.generate()
        for number in range(4):
            name, who = ("Good", key) if number < 2 else ("Bad", other)
            request = signed_request(store, season, who, number, method=method(name))
            store.add(request)
            result = failed_result(season, request.id)
            if name == "Good":
                runs = [run.model_copy(update={"wd_regret": 0.5}) for run in result.runs]
                result = sealed_result(season, request.id, runs, {}, 100, result.stepping)
            store.finish(result)
        later()
        reveal(store, season)
        assert score_entries(store, season.id) == 4
        rows = season_rankings(store, season, "wd_regret")["generic"]
    shown = [(row.entry.method, row.value.value, row.entry.runs, row.reason) for row in rows]
    assert shown == [("Good", 0.5, 4, reason), ("Bad", 1.0, 4, reason)]


def tops(ranked):
    """Methods and their N₀."""
    for row in ranked:
        assert row.entry.scores is not None
        yield row.entry.method, row.entry.scores.wd_regret.value


def test_both_seasons_are_ranked_as_the_page_says():
    with SeasonStore.open(SEASONS, read_only=True) as store:
        for season, best in (("winter", ["SAC", "PPO"]), ("autumn", ["IQL", "BC"])):
            document = store.season(season)
            assert document.is_committed_to(store.revealed_master(season))
            ranked = season_rankings(store, document, "wd_regret")
            names = [row.entry.method for row in ranked["generic"]]
            assert set(best) < set(names)
            assert names[-1] == "Constant 0.5"
            own, others = (dict(tops(ranked[kind])) for kind in ("family", "generic"))
            assert all(own["Family fit (short)"] < others[name] for name in best)
        for row in counting(store, store.season("winter")):
            assert {each.steps for each in store.sealed_result(row).stepping} <= {0, 10_000}
    assert not list(SEASONS.rglob("*.key"))
    assert sum(path.stat().st_size for path in SEASONS.rglob("*") if path.is_file()) < 3_500_000
