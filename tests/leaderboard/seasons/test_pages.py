"""The pages of sealed seasons: before, during and after, and nothing secret before the reveal."""

import pytest

from leaderboard import admission
from leaderboard.seasons.season import Reveal, Stepping
from leaderboard.seasons.web import SECTION
from leaderboard.web.pages import Pages
from leaderboard.web.server import write_site
from tests.leaderboard.clocks import move_clock
from tests.leaderboard.seasons.sealing import (
    MASTER,
    failed_result,
    signed_entry,
    signed_request,
    tiny_season,
)
from tests.leaderboard.web import boards, test_pages
from tests.page import Page

HOSTILE = "Autumn <script>alert(1)</script>"
OFFLINE, ONLINE = tiny_season(id="autumn", title=HOSTILE), tiny_season("sealed-online", id="winter")


CURVE = Stepping(steps=64, normalised_online_regret=0.625, learning_curve=(1.0, 0.75, 0.125))


def entry(store, key, knowledge="generic", note=""):
    method = {"name": f"Mine {knowledge}", "version": "1", "family": "x", "knowledge": knowledge}
    signed = signed_entry(store, OFFLINE, key, [None, None], method=method, statement=note)
    store.add(signed)
    return signed.id


@pytest.fixture
def board(tmp_path):
    with boards.create(tmp_path / "board") as store:
        yield store


def page(store, path, **options):
    return Page(Pages(store, sections=[SECTION], **options).read(path).decode())


def test_a_board_without_seasons_has_no_page_of_them(board):
    assert Pages(board, sections=[SECTION]).read("seasons.html") is None
    assert "Seasons" not in page(board, "index.html").words


def test_the_page_of_a_season_before_and_after_its_reveal(board, key, monkeypatch):
    board.announce(OFFLINE)
    entry(board, key, note="an earlier one")
    last, fitted = entry(board, key), entry(board, key, "family")
    before = page(board, "seasons/autumn.html")
    assert HOSTILE in before.words
    assert OFFLINE.commitment in before.words
    assert "an entry of the organiser proves nothing" in before.words
    assert before.words.count("replaced") == 1
    assert before.words.count("waits for the reveal") == 2
    assert MASTER.raw.hex() not in before.words
    assert "Ranked by" not in before.words
    assert page(board, "seasons.html").words.count("sealed-offline") == 1
    assert "Seasons" in page(board, "index.html").words

    move_clock(monkeypatch)
    board.reveal(Reveal(season=OFFLINE.digest, master=MASTER.raw.hex()))
    for id in (last, fitted):
        board.finish(failed_result(OFFLINE, id))
    after = page(board, "seasons/autumn.html")
    assert MASTER.raw.hex() in after.words
    generic, family = (after.words.index(f"Methods {text}") for text in ("without", "that declare"))
    assert generic < after.words.index("Mine generic") < family < after.words.index("Mine family")
    assert after.words.count("Methods of its key") == 2
    assert after.words.count("too few runs") == 2  # of the ten that this board needs


def test_a_tickets_learning_curve_is_shown_when_it_ends(board, key):
    board.announce(ONLINE)
    request = signed_request(board, ONLINE, key)
    board.add(request)
    running = page(board, "seasons/winter.html")
    assert "running" in running.words
    assert request.content.nonce not in running.words
    assert request.signature not in running.words
    board.queue.add_jobs([request.id])
    over = page(board, "seasons/winter.html").words
    assert "waits to be scored: place 1 of 1 in the queue" in over
    assert "running" not in over
    board.finish(failed_result(ONLINE, request.id, CURVE))
    ended = page(board, "seasons/winter.html")
    assert "0.625" in ended.words
    labels = [svg.get("aria-label", "") for svg in ended.all("svg")]
    assert sum(label.startswith("From the first step: 1.00") for label in labels) == 1


def test_a_season_is_shown_before_the_boards_reference_rows_but_not_its_scores(
    tmp_path, key, monkeypatch
):
    monkeypatch.setattr(boards, "submit", lambda *args, **fields: None)
    with boards.create(tmp_path / "board", classes=1) as board:
        admission.submit_references(board)
        board.announce(ONLINE)
        request = signed_request(board, ONLINE, key)
        board.add(request)
        assert "running" in page(board, "seasons/winter.html", address="http://board.test").words
        board.finish(failed_result(ONLINE, request.id, CURVE))
        prepares = page(board, "seasons/winter.html", address="http://board.test")
    assert "Preparing." in prepares.words
    assert "0.625" not in prepares.words
    links = [each["href"] for each in prepares.all("link") + prepares.all("a") if "href" in each]
    assert [link for link in links if not link.startswith(("../", "#"))] == []


def test_the_site_of_a_board_with_seasons_is_well_formed_and_its_links_work(board, key, tmp_path):
    board.announce(OFFLINE)
    board.announce(ONLINE)
    entry(board, key)
    board.add(signed_request(board, ONLINE, key))
    site = write_site(board, tmp_path / "site", sections=[SECTION]).parent
    pages = {
        path.relative_to(site).as_posix(): Page(path.read_text()) for path in site.rglob("*.html")
    }
    assert {"seasons.html", "seasons/autumn.html", "seasons/winter.html"} <= set(pages)
    test_pages.test_every_page_has_landmarks_a_title_one_heading_and_no_id_twice(pages)
    test_pages.test_tables_have_captions_scopes_and_focusable_boxes(pages)
    scripts = {script["src"] for each in pages.values() for script in each.all("script")}
    assert scripts <= {"static/board.js", "../static/season.js", "board-data.js"}
    assert test_pages.follow_links(pages, site)["inside"] > 30
