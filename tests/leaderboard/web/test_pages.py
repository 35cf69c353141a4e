import dataclasses
import json
import posixpath
import re
import shutil
from collections import Counter
from urllib.parse import urlsplit
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from leaderboard import admission
from leaderboard.documents.board import hex_of
from leaderboard.documents.result import Copies, Estimate
from leaderboard.documents.signed import SigningKey
from leaderboard.errors import NotPublishable
from leaderboard.scoring.worker import run_scorer
from leaderboard.seasons.store import SeasonStore
from leaderboard.store import Store
from leaderboard.web import pages as site_pages
from leaderboard.web import tables
from leaderboard.web.pages import Pages, content_type
from leaderboard.web.server import write_site
from sme_registry.errors import OptionError
from tests.leaderboard.conftest import SEASONS, signed_withdrawal
from tests.leaderboard.web import boards
from tests.page import Page

ELEMENTS = """
html head meta title link script body a header footer main nav div section p span strong em small
bdi ul li dl dt dd h1 h2 h3 table caption thead tbody tr th td form label input select option button
details summary code pre figure figcaption time br sub
svg path line circle polyline polygon text desc
"""
ALLOWED = set(ELEMENTS.split())


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    with boards.create(folder / "board") as store:
        key = SigningKey.generate()
        gone = boards.submit(store, key, "Gone", [0.3] * 6)
        ids = boards.furnish(store)
        assert store.withdraw(signed_withdrawal(store, gone, key, boards.HOSTILE))
        yield store, {**ids, "gone": gone}


@pytest.fixture
def small(tmp_path):
    """A board of one class, with its reference rows alone."""
    with boards.create(tmp_path / "board", classes=1) as store:
        yield store


def submitted(store, name, profile, **fields):
    return boards.submit(store, SigningKey.generate(), name, profile, **fields)


@pytest.fixture(scope="module")
def site(board, tmp_path_factory):
    return write_site(board[0], tmp_path_factory.mktemp("site") / "new").parent


@pytest.fixture(scope="module")
def pages(site):
    found = {
        path.relative_to(site).as_posix(): Page(path.read_text()) for path in site.rglob("*.html")
    }
    assert len(found) == 20
    return found


def test_no_page_has_inline_script_or_style_or_unexpected_elements(pages):
    for name, page in pages.items():
        for tag, attributes in page.elements:
            assert tag in ALLOWED, (name, tag)
            assert not any(key.startswith("on") or key == "style" for key in attributes), name
            if tag == "script":
                assert re.fullmatch(r"static/board\.js|board-data\.js", attributes["src"]), name
        assert all(tag != "script" or not data.strip() for tag, data in page.text), name


def test_every_page_has_landmarks_a_title_one_heading_and_no_id_twice(pages):
    for name, page in pages.items():
        assert page.all("html")[0]["lang"] == "en"
        count = Counter(tag for tag, _ in page.elements)
        assert count["main"] == count["h1"] == count["header"] == 1, name
        assert next(text for tag, text in page.text if tag == "title").endswith("Smoke board")
        assert count["footer"] == 1
        ids = Counter(a["id"] for _, a in page.elements if "id" in a)
        assert max(ids.values()) == 1, (name, ids)
        named = [
            identifier
            for _, attributes in page.elements
            for identifier in (attributes.get("aria-labelledby") or "").split()
        ]
        assert set(named) <= set(ids), name


def test_tables_have_captions_scopes_and_focusable_boxes(pages):
    for name, page in pages.items():
        assert all("scope" in attributes for attributes in page.all("th")), name
        drawn = [a for a in page.all("table") if "data-table" not in a]
        assert len(page.all("caption")) == len(drawn), name
        boxes = [a for a in page.all("div") if "scroll" in (a.get("class") or "").split()]
        assert all(a["tabindex"] == "0" and a["role"] == "region" for a in boxes), name
        for picture in page.all("svg"):
            labelled = picture.get("aria-labelledby") or picture.get("aria-label")
            assert picture.get("aria-hidden") == "true" or (
                picture["role"] == "img" and labelled
            ), name


def test_every_link_targets_a_file_of_the_site_or_https(pages, site):
    followed = follow_links(pages, site)
    assert followed["inside"] > 100
    assert followed["outside"] == 2 * 3 + 2  # two entries have a link: on each board, on their page


def follow_links(pages, site):
    """Counts the links within a site, which must have targets, and those that leave it."""
    followed = Counter()
    for name, page in pages.items():
        for tag, attributes in page.elements:
            for key in {"href", "src", "action"} & attributes.keys():
                target = urlsplit(attributes[key])
                if target.scheme:
                    assert (tag, target.scheme) == ("a", "https")
                    assert "noopener" in attributes["rel"]
                    followed["outside"] += 1
                    continue
                assert not target.netloc
                path = posixpath.normpath(posixpath.join(posixpath.dirname(name), target.path))
                where = path if target.path else name
                assert (site / where).is_file(), (name, attributes[key])
                if target.fragment:
                    there = pages[where].elements
                    assert any(a.get("id") == target.fragment for _, a in there), attributes[key]
                followed["inside"] += 1
    return followed


def test_a_board_says_how_to_submit_and_its_limits_unless_it_accepts_nothing(board, pages):
    for name in ("index.html", "ood_regret.html", "ood_decay.html"):
        assert "This copy of the board accepts no submissions." in pages[name].words
        words = pages[name].words.split("How to submit")[1]
        assert "A rank needs 30 trained policies" in words
        assert "20 submissions and 1,024 MiB" in words
    for name, page in pages.items():
        assert any(a["href"].endswith("index.html#submit") for a in page.all("a")), name
    page = Page(html(Pages(board[0], "https://x/<script>"), "index.html"))
    assert "submit runs/mine https://x/<script>" in page.words
    with SeasonStore.open(SEASONS, read_only=True) as store:
        words = Page(html(Pages(store), "index.html")).words.split("How to submit")[1]
    assert "accepts no submissions" in words
    assert "sme-leaderboard submit" not in words


def test_the_log_states_its_head_and_the_suite_its_instances(pages, board):
    store, _ = board
    assert store.head[1] in pages["log.html"].words
    words = pages["suite.html"].words
    for digest, (member, spec) in store.document.instances.items():
        assert f"{spec.seed} {hex_of(digest)[:12]}" in words
        assert member in words
    assert "state_dim=2" in words
    assert f"--seeds {store.document.runs_to_rank} " in words


def html(pages, path):
    return pages.read(path).decode()


def rows_of(text):
    """Rank, method, and the whole row's words, of each row of the board."""
    table = text[text.index('<table class="board"') : text.index("</table>")]
    rows = []
    for row in re.findall(r"<tr.*?</tr>", table, re.DOTALL):
        if 'class="rank"' in row:
            cell = re.search(r'class="rank"[^>]*>([^<]*)', row)[1]
            rows.append((cell, re.search(r'class="name" data-value="([^"]*)', row)[1], row))
    return rows


def test_the_board_shows_rank_ranges_references_and_what_is_not_ranked_with_its_reason(site):
    rows = rows_of((site / "index.html").read_text())
    shown = [(rank, name) for rank, name, _ in rows]
    assert shown[:5] == [
        ("ref.", "optimal"),
        ("ref.", "constant"),
        ("1", "DUN-fit"),
        ("2–3", "SAC"),
        ("2–3", "TD3"),
    ]
    assert shown[-1] == ("–", "PPO small")
    assert ">too few runs</span>" in rows[-1][2]
    assert 'href="method.html#oracle-like"' in rows[2][2]
    assert ">requested</td>" in rows[2][2]
    assert 'href="https://example.org/sac?a=1&amp;b=2"' in rows[3][2]
    assert 'data-label="Steps per run" data-value="1000000">1 M</td>' in rows[3][2]
    assert re.search(r'<time datetime="(\d{4}-\d\d-\d\d)T[^"]*">\1</time>', rows[3][2])
    assert all('class="bar"' in row and 'class="spark"' in row for _, _, row in rows)


def test_the_decay_page_ranks_by_the_floored_value_and_shows_the_entrys_own(small):
    submitted(small, "Worse inside", [0.3, *[0.1] * 5], spread=0.0)
    submitted(small, "Better", [0.1] * 6, spread=0.0)
    submitted(small, "Near", [4e-7, *[0.0] * 5], spread=0.0)
    pages = Pages(small)
    rows = {name: row for _, name, row in rows_of(html(pages, "ood_decay.html"))}
    assert 'data-value="0.0"' in rows["Worse inside"]
    assert "<span>itself \u22120.054</span>" in rows["Worse inside"]
    assert "itself" not in rows["Better"]
    assert any(-1e-6 < entry.scores.ood_decay.value < 0 for entry in pages.entries)
    assert "-0.000" not in html(pages, "board.tex")


def test_a_superseded_entry_is_listed_as_history_and_its_versions_link_to_one_another(small):
    key = SigningKey.generate()
    first = boards.submit(small, key, "PPO", [0.2] * 6, statement="first")
    second = boards.submit(small, key, "P-P-0", [0.2] * 6, statement="second")
    submitted(small, "PPO", [0.3] * 6)
    pages = Pages(small)
    marks = {name: row for _, name, row in rows_of(html(pages, "index.html"))}
    old, new = (
        Page(html(pages, f"submissions/{hex_of(first)}.html")),
        Page(html(pages, f"submissions/{hex_of(second)}.html")),
    )
    assert ">superseded</span>" in marks["PPO"] or ">superseded</span>" in marks["P-P-0"]
    assert "Superseded." in old.words
    assert "Superseded." not in new.words
    for page, other in ((old, second), (new, first)):
        assert f"{hex_of(other)}.html" in [a["href"] for a in page.all("a")]
        assert "History of this method" in page.words


def test_a_copy_names_the_entry_that_it_copies_and_the_number_of_runs(small, monkeypatch):
    first, copy = (submitted(small, name, [0.2] * 6) for name in ("First", "Copy"))
    alike = (Copies(first, small.entry(first).key, 10),)
    entries = [
        dataclasses.replace(entry, alike=alike) if entry.id == copy else entry
        for entry in small.entries()
    ]
    monkeypatch.setattr(small, "entries", lambda: list(entries))
    pages = Pages(small)
    shown = {name: (rank, row) for rank, name, row in rows_of(html(pages, "index.html"))}
    assert shown["First"][0] == "1"
    assert shown["Copy"][0] == "–"
    link = f'href="submissions/{hex_of(first)}.html"'
    assert f"{link}>copy of <bdi>First 1.0" in shown["Copy"][1]
    words = Page(html(pages, f"submissions/{hex_of(copy)}.html")).words
    assert "10 of 10 policies act like those of earlier entries" in words


def test_submissions_that_are_not_scored_are_listed_below_with_their_status(pages):
    words = pages["index.html"].words
    waiting, closed = words.split("Waiting to be scored")[1].split("Rejected and withdrawn")
    assert re.search(r"Attempts PPO 2\.7\.2 ?by R\. Okafor ?\d{4}-\d\d-\d\d \d\d:\d\d", waiting)
    assert re.search(r"Broken 0\.1.*rejected onnx_op", closed)
    assert re.search(r"Gone 1\.0.*withdrawn", closed)
    assert "1 waiting" in words.split("Waiting to be scored")[0]


def test_the_page_of_a_submission_shows_its_status(board, pages, site):
    store, ids = board
    run = store.result(ids["sac"]).runs[0]
    for kind, texts in {
        "sac": (
            "Regret over the regions",
            f"{run.evaluation_seed}",
            "onnxruntime 1.24.1",
            "No tuning on the evaluation states.",
        ),
        "rejected": ("Rejected: onnx_op", "op_type='Loop<script>'"),
        "waiting": ("Waiting to be scored",),
        "gone": ("Withdrawn by its submitter", f"Reason: {boards.HOSTILE}"),
    }.items():
        digits = hex_of(ids[kind])
        words = pages[f"submissions/{digits}.html"].words
        key = store.submission(ids[kind]).content.submitter.key
        assert all(text in words for text in (key, ids[kind], *texts)), kind
        assert (site / f"results/{digits}.json").is_file() == (kind != "waiting")
        assert ("Reason:" in words) == (kind == "gone")


def test_runs_that_were_started_and_not_listed_are_shown(board, pages):
    store, ids = board
    words = pages[f"submissions/{hex_of(ids['ppo'])}.html"].words
    assert [each.runs for each in store.result(ids["ppo"]).classes] == [11] * 3
    assert "3 more runs were started and not listed, and count as failed." in words


def test_the_json_files_are_the_signed_submission_and_its_result(board, site):
    store, ids = board
    digits = hex_of(ids["sac"])
    signed = (site / f"submissions/{digits}.json").read_bytes()
    assert signed == store.submission(ids["sac"]).to_bytes()
    result = json.loads((site / f"results/{digits}.json").read_text())
    assert result == store.result(ids["sac"]).to_dict()


def test_hostile_text_stays_text_on_every_page(board, pages, site):
    _, ids = board
    page = pages[f"submissions/{hex_of(ids['hostile'])}.html"]
    words = "".join(data for _, data in page.text)
    assert boards.HOSTILE * 3 in words
    assert "</dd></dl>" in words
    links = [a["href"] for a in page.all("a") if a["href"].startswith("https:")]
    assert links == ['https://example.org/"onmouseover="alert(1)\'<script>'] * 1
    rows = [a for a in pages["index.html"].all("tr") if "data-family" in a]
    assert "a\"onx='" in [a["data-family"] for a in rows]
    data = (site / "board-data.js").read_text()
    assert data.isascii()
    entries = json.loads(data.removeprefix("window.boardData = ").removesuffix(";\n"))["entries"]
    assert "x<b>y" in " ".join(entry["name"] for entry in entries)
    # What would turn the direction of the words that follow is kept to the name itself.
    assert f"<bdi>{boards.RTL}" in (site / "index.html").read_text()


def test_the_comparison_has_exactly_the_scored_entries(board, site):
    store, ids = board
    text = (site / "board-data.js").read_text()
    data = json.loads(text.removeprefix("window.boardData = ").removesuffix(";\n"))
    shown = {f"sha256:{entry['id']}" for entry in data["entries"]}
    assert shown >= {ids[name] for name in ("sac", "td3", "ppo", "few", "hostile")}
    assert not shown & {ids[name] for name in ("rejected", "waiting", "gone")}
    sac = next(entry for entry in data["entries"] if entry["id"] == hex_of(ids["sac"]))
    scores = store.result(ids["sac"]).scores
    assert sac["normalised_regret"][2] == pytest.approx(
        [
            scores.normalised_regret[2].value,
            scores.normalised_regret[2].low,
            scores.normalised_regret[2].high,
        ],
        abs=1e-5,
    )
    assert data["regions"] == ["WD", "0–0.2", "0.2–0.4", "0.4–0.6", "0.6–0.8", "0.8–1"]


def test_the_same_board_gives_the_same_bytes_and_leaves_equal_files_alone(board, site, tmp_path):
    store, _ = board
    steps = []
    write_site(store, tmp_path, lambda done, total: steps.append((done, total)))
    first = {p.relative_to(site).as_posix(): p for p in site.rglob("*") if p.is_file()}
    second = {p.relative_to(tmp_path).as_posix(): p for p in tmp_path.rglob("*") if p.is_file()}
    assert steps == [(number, len(second)) for number in range(1, len(second) + 1)]
    assert first.keys() == second.keys()
    pages = Pages(store)
    for name, path in first.items():
        assert path.read_bytes() == second[name].read_bytes() == pages.read(name), name
        assert content_type(name)
    before = {path: path.stat().st_ino for path in second.values()}
    (tmp_path / "ood_regret.html").write_text("half a pa")
    (tmp_path / "mine.txt").write_text("not the site's")
    write_site(store, tmp_path)
    after = {path: path.stat().st_ino for path in second.values()}
    changed = [path.name for path in before if before[path] != after[path]]
    assert changed == ["ood_regret.html"]
    assert (tmp_path / "ood_regret.html").read_bytes() == (site / "ood_regret.html").read_bytes()
    assert (tmp_path / "mine.txt").exists()


def test_other_paths_are_not_found(board):
    store, ids = board
    pages = Pages(store)
    for path in (
        "",
        "../board.key",
        "static/../pages.py",
        *(f"log-{number}.html" for number in ("1", "00", "٣", "-1")),
        "submissions/abc.html",
        f"submissions/{'0' * 64}.html",
        f"results/{'0' * 64}.html",
        f"results/{hex_of(ids['waiting'])}.json",
        "index.html/x",
        "board.key",
    ):
        assert pages.read(path) is None, path


def test_a_board_with_wrong_references_writes_no_pages(tmp_path):
    with boards.create(tmp_path / "board", classes=1, references=False) as store:
        submitted(store, "PPO", [0.2] * 6)
        with pytest.raises(NotPublishable, match="optimal"):
            write_site(store, tmp_path / "site")
        assert not (tmp_path / "site").exists()
        for path in ("index.html", "board.csv", "board-data.js", "log.html", "compare.html"):
            with pytest.raises(NotPublishable):
                Pages(store).read(path)
        assert Pages(store).read("static/board.css")


def test_pages_never_replace_a_boards_own_files(small, tmp_path):
    (tmp_path / "link").symlink_to("board")
    (tmp_path / "keyed").mkdir()
    SigningKey.generate().write(tmp_path / "keyed" / "board.key")
    shutil.copytree(small.folder.path, tmp_path / "other")
    (tmp_path / "other" / "board.key").unlink()  # as one that is handed on
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.json")}
    own = ("log", "objects/site", "results", "seasons", "submissions", "withdrawals/x", "site/..")
    inside = [f"board/{name}" for name in own]
    for out in ("board", "link", *inside, "other", "other/results", "keyed"):
        with pytest.raises(OptionError, match=r"belongs to the board .* another folder"):
            write_site(small, tmp_path / out)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} == before
        assert not list(tmp_path.rglob("*.html"))


def test_pages_may_be_in_a_board_or_next_to_it(small, tmp_path):
    for out in (tmp_path / "board" / "site", tmp_path):
        for _ in range(2):  # the site's own board.json makes no board of its folder
            assert write_site(small, out).is_file()
    with Store.open(tmp_path / "board", read_only=True) as store:
        assert len(store.entries()) == 2


def test_a_long_log_has_pages_and_full_ones_never_change(board, monkeypatch):
    store, _ = board
    monkeypatch.setattr(site_pages, "LOG_ROWS", 10)
    pages = Pages(store)
    last = store.head[0]
    count = last // 10 + 1
    assert f"log-{count - 1}.html" in set(pages.paths())
    shown = [
        int(number)
        for page in range(count)
        for number in re.findall(
            r'<th scope="row" class="n">(\d+)</th>', html(pages, f"log-{page}.html")
        )
    ]
    assert shown == list(range(last + 1))
    newest = pages.read("log.html")
    assert newest == pages.read(f"log-{count - 1}.html")
    assert Page(newest.decode()).all("nav")[1]["aria-label"] == "Pages of the log"


def test_steps_are_short_and_only_https_becomes_a_link():
    shown = {0: "0", 999: "999", 1000: "1 k", 1_250_000: "1.25 M", 30_000_000_000: "30 G"}
    assert {steps: tables.steps_text(steps) for steps in shown} == shown
    assert tables.https_only("https://example.org/") == "https://example.org/"
    for link in (None, "javascript:alert(1)", "http://example.org", " https://example.org"):
        assert tables.https_only(link) is None


def test_contrast_is_enough_in_light_and_dark(board):
    """WCAG 2: 4.5 for text, 3 for what is drawn."""

    def luminance(colour):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    def contrast(one, other):
        high, low = sorted((luminance(one), luminance(other)), reverse=True)
        return (high + 0.05) / (low + 0.05)

    css = Pages(board[0]).read("static/board.css").decode()
    pairs = re.findall(r"--([\w-]+): light-dark\((#[0-9a-f]{6}), (#[0-9a-f]{6})\);", css)
    assert len(pairs) == 20
    for scheme in (1, 2):
        colour = {pair[0]: pair[scheme] for pair in pairs}
        for ground in ("page", "surface", "sunken", "accent-wash"):
            for text in ("ink", "muted", "accent"):
                assert contrast(colour[text], colour[ground]) >= 4.5, (text, ground)
        for text in ("warn", "bad"):
            assert contrast(colour[text], colour[f"{text}-wash"]) >= 4.5
        assert contrast(colour["page"], colour["accent"]) >= 4.5  # the button
        for series in range(6):
            assert contrast(colour[f"series-{series}"], colour["surface"]) >= 4.5
        assert contrast(colour["axis"], colour["surface"]) >= 3


def test_explorers_are_written_on_request_and_linked(tmp_path, store, submit):
    admission.submit_references(store)
    submit(300)
    assert run_scorer(store.folder.path) == 3
    site = write_site(store, tmp_path / "site", explorers=True).parent
    listed = [*Pages(store, explorers=True).paths()]
    assert not any("explorer" in path for path in Pages(store).paths())
    assert Pages(store).read(next(p for p in listed if p.startswith("explorers/"))) is None
    assert Pages(store, explorers=True).read("explorers/x-0.html") is None
    pages = {path for path in listed if path.startswith("explorers/")}
    texts = "".join(page.read_text() for page in (site / "submissions").glob("*.html"))
    assert set(re.findall(r"explorers/[^\"]+", texts)) == pages
    assert len(pages) == 3
    texts = "".join((site / path).read_text() for path in pages)
    assert '"of":"observation"' in texts
    for name in re.findall(r'(?:src|href)="\.\./(static/[^"]+)"', texts):
        assert (site / name).is_file()


# Charts.


def test_a_bar_spans_its_interval_and_marks_its_value():
    estimate = Estimate(value=0.5, low=0.25, high=1.0)
    bar = ElementTree.fromstring(
        tables.Bars([estimate], {"optimal": 0.0, "constant": 1.0}).bar(estimate)
    )
    interval = bar.find("line[@class='ci']")
    assert (interval.get("x1"), interval.get("x2")) == ("26.50%", "97.00%")
    assert bar.find("circle").get("cx") == "50.00%"
    assert bar.find("line[@class='optimal']").get("x1") == "3.00%"
    assert bar.find("line[@class='constant']").get("x1") == "97.00%"


@given(st.lists(st.floats(-1e6, 1e6), max_size=5))
def test_a_scale_covers_every_value_with_round_ends(values):
    scale = tables.Scale.covering(*values)
    assert scale.low < scale.high
    assert 2 <= len(scale.ticks) <= 8
    for value in values:
        margin = 1e-6 * (scale.high - scale.low)
        assert scale.low - margin <= value <= scale.high + margin
        assert 0.0 <= scale.part(value) <= 1.0
