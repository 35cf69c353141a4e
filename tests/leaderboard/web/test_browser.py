"""The pages in a real browser: from files and from a server that forbids everything inline."""

import re

import pytest
from playwright.sync_api import expect

from leaderboard import admission
from leaderboard.documents.board import hex_of
from leaderboard.web.server import write_site
from tests.browser import needs_chromium, serving_files
from tests.leaderboard.serving import serving
from tests.leaderboard.web import boards

CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
WIDTHS = {"desktop": 1280, "tablet": 820, "phone": 360}

expect.set_options(timeout=30_000)  # Playwright's own 5 s are for machines with nothing else to do

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    with boards.create(folder / "board") as store:
        ids = boards.furnish(store)
        return write_site(store, folder / "site").parent, {k: hex_of(v) for k, v in ids.items()}


@pytest.fixture(scope="module")
def served(written):
    headers = {"Content-Security-Policy": CSP, "X-Content-Type-Options": "nosniff"}
    with serving_files(written[0], headers) as address:
        yield address


@pytest.fixture
def opened(chromium):
    """Opens pages, and fails where one complained."""
    contexts, problems = [], []

    def failed(request):
        if request.failure != "net::ERR_ABORTED":  # the page was left before its icon had come
            problems.append(f"{request.url}: {request.failure}")

    def open_(address, width="desktop", **options):
        context = chromium.new_context(viewport={"width": WIDTHS[width], "height": 800}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: problems.append(f"{page.url}: {message.text}"))
        page.on("pageerror", lambda error: problems.append(f"{page.url}: {error}"))
        page.on("requestfailed", failed)
        page.on("dialog", lambda dialog: (problems.append("a dialog"), dialog.dismiss()))
        page.goto(address)
        return page

    yield open_
    for context in contexts:
        context.close()
    assert problems == []


def all_pages(ids):
    yield from ("index.html", "ood_regret.html", "ood_decay.html", "method.html", "suite.html")
    yield from ("log.html", "compare.html")
    yield f"compare.html?id={ids['sac'][:16]}&id={ids['long'][:16]}&id={ids['hostile'][:16]}"
    yield from (f"submissions/{digits}.html" for digits in ids.values())


def test_no_page_complains_or_is_wider_than_the_screen_or_has_a_control_without_a_name(
    served, opened, written
):
    named, page = 0, opened(served + "index.html")
    for name in all_pages(written[1]):
        page.goto(served + name)
        for width in WIDTHS.values():
            page.set_viewport_size({"width": width, "height": 800})
            wide, screen = page.evaluate(
                "[document.documentElement.scrollWidth, window.innerWidth]"
            )
            assert screen == width
            assert wide <= screen, name
            if width == WIDTHS["tablet"]:
                continue
            tree = page.locator("body").aria_snapshot()
            named += named_controls(name, tree)
            if name == "index.html":
                # Cards are still a table to a screen reader.
                assert re.search(r"- '?row \"Compare SAC 2\.7\.1", tree)
                assert re.search(r"- '?rowheader \"SAC 2\.7\.1", tree)
                assert re.search(r"- '?cell \"(Rank )?2–3", tree)
        fonts = page.evaluate("getComputedStyle(document.body).fontFamily")
        assert "system-ui" in fonts, f"{name}: the style sheet was not loaded"
    assert named > 600


def named_controls(name, tree):
    """Counts the controls of a page, all of which must have an accessible name."""
    roles = "button|checkbox|combobox|searchbox|link|img|table|region|navigation|form"
    named = 0
    for line in tree.splitlines():
        if role := re.match(rf"\s*- '?({roles})\b(.*)", line):
            assert role[2].strip().startswith(('"', "/")), f"{name}: no name: {line}"
            named += 1
    return named


@pytest.mark.parametrize("width", ["desktop", "phone"])
def test_chosen_entries_are_laid_over_one_another(written, served, width, opened):
    origin = served if width == "phone" else f"{written[0].as_uri()}/"  # files work as well
    page = opened(origin + "index.html", width)
    page.get_by_role("checkbox", name="Compare SAC 2.7.1").check()
    page.get_by_role("checkbox", name="Compare PPO 2.7.1").check()
    expect(page.get_by_text("2 of at most 6 selected.")).to_be_visible()
    page.get_by_role("button", name="Compare selected").click()
    expect(page).to_have_url(re.compile(r"compare\.html\?id="))
    chart = page.get_by_role("img", name="Normalised regret by region")
    expect(chart).to_be_visible()
    expect(chart.locator(".overlay")).to_have_count(2)
    table = page.get_by_role("table")
    expect(table.get_by_role("columnheader")).to_have_text(["Score", "SAC 2.7.1", "PPO 2.7.1"])
    row = table.get_by_role("row", name="WD regret N₀")
    cells = row.get_by_role("cell").all_inner_texts()
    values = [float(re.match(r"[\d.]+", cell)[0]) for cell in cells]
    difference = float(re.search(r"Δ \+([\d.]+)", cells[1])[1])
    assert difference == pytest.approx(values[1] - values[0], abs=0.0011)

    page.get_by_role("combobox", name="Add an entry").select_option(
        label="TD3 2.7.1, by Control Lab, Delft"
    )
    expect(chart.locator(".overlay")).to_have_count(3)
    page.get_by_role("button", name="Remove SAC").click()
    expect(chart.locator(".overlay")).to_have_count(2)
    expect(table.get_by_role("columnheader")).to_have_text(["Score", "PPO 2.7.1", "TD3 2.7.1"])


def test_an_address_with_ids_after_the_hash_is_understood_and_a_hostile_name_is_a_name(
    served, opened, written
):
    ids = written[1]
    page = opened(f"{served}compare.html#{ids['sac']},{ids['td3'][:16]},{'0' * 16},x<b>")
    expect(page.locator("[data-legend] li")).to_have_count(2)
    page = opened(f"{served}compare.html?id={ids['hostile']}")
    expect(page.locator("[data-legend] a")).to_contain_text("x<b>y <script>alert(1)")
    assert page.evaluate("document.querySelectorAll('b, img').length") == 0


def test_six_entries_are_the_most(served, opened):
    page = opened(served + "index.html")
    boxes = page.get_by_role("checkbox")
    for index in range(6):
        boxes.nth(index).check()
    expect(boxes.nth(6)).to_be_disabled()
    page.get_by_role("button", name="Compare selected").click()
    expect(page.locator(".overlay")).to_have_count(6)
    expect(page.get_by_role("combobox", name="Add an entry")).to_be_disabled()


def test_the_board_is_filtered_and_sorted(served, opened):
    page = opened(served + "index.html")
    names = page.locator("tbody[data-rows] tr:not([hidden]) .name > a")
    everyone = names.all_inner_texts()
    page.get_by_role("combobox", name="Family").select_option("PPO")
    expect(names).to_have_text(["PPO", "PPO small"])
    expect(page.get_by_role("status")).to_have_text("2 of 7 entries shown")
    page.get_by_role("combobox", name="Family").select_option("")
    page.get_by_role("combobox", name="Knowledge").select_option("family")
    expect(names).to_have_text(["DUN-fit"])
    page.get_by_role("combobox", name="Knowledge").select_option("")
    page.get_by_role("searchbox", name="Method or submitter").fill("control lab")
    expect(names).to_have_text(["SAC", "TD3"])
    page.get_by_role("searchbox", name="Method or submitter").fill("")
    assert names.all_inner_texts() == everyone

    page.get_by_role("button", name="Method", exact=True).click()
    ranked = everyone[:-1]  # the last is listed, not ranked, and stays below
    expect(names).to_have_text([*sorted(ranked, key=str.lower), everyone[-1]])
    page.get_by_role("button", name="N₀", exact=True).click()
    expect(names).to_have_text(everyone)
    page.get_by_role("button", name="N₀", exact=True).click()
    expect(names).to_have_text([*reversed(ranked), everyone[-1]])
    head = page.get_by_role("columnheader", name="N₀", exact=True)
    expect(head).to_have_attribute("aria-sort", "descending")


def test_a_narrow_board_is_sorted_by_a_list_and_a_button_and_a_wide_one_by_its_headers(
    served, opened
):
    page = opened(served + "index.html")
    fields = page.get_by_role("combobox", name="Sort by")
    expect(page.get_by_role("button", name="Received")).to_be_visible()
    expect(fields).to_be_hidden()
    names = page.locator("tbody[data-rows] tr:not([hidden]) .name > a")
    *ranked, listed = names.all_inner_texts()
    for width in ("tablet", "phone"):
        page.set_viewport_size({"width": WIDTHS[width], "height": 800})
        expect(fields).to_be_visible()
        fields.select_option("Method")
        expect(names).to_have_text([*sorted(ranked, key=str.lower), listed])
        fields.select_option("N₀")
        page.get_by_role("button", name="Ascending").click()
        expect(names).to_have_text([*reversed(ranked), listed])
        page.get_by_role("button", name="Descending").click()
        expect(names).to_have_text([*ranked, listed])


def test_without_script_the_board_is_whole_and_the_comparison_says_what_is_missing(served, opened):
    page = opened(served + "index.html", java_script_enabled=False)
    expect(page.get_by_role("row", name=re.compile("SAC 2.7.1"))).to_be_visible()
    expect(page.get_by_role("combobox")).to_have_count(0)
    expect(page.locator(".bar").first).to_be_visible()
    page.get_by_role("checkbox", name="Compare SAC").check()
    page.get_by_role("button", name="Compare selected").click()
    expect(page.get_by_text("The comparison needs JavaScript")).to_be_visible()
    expect(page.get_by_role("combobox")).to_have_count(0)


def test_the_keyboard_reaches_the_content_first_and_shows_where_it_is(served, opened):
    page = opened(served + "index.html")
    page.keyboard.press("Tab")
    skip = page.get_by_role("link", name="Skip to content")
    expect(skip).to_be_focused()
    expect(skip).to_be_in_viewport()
    page.keyboard.press("Enter")
    expect(page.locator("main")).to_be_focused()
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid"


def test_dark_is_dark_and_light_is_light(served, opened):
    def brightness(scheme):
        page = opened(served + "index.html", color_scheme=scheme)
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return sum(map(int, re.findall(r"\d+", colour)[:3])) / 3

    assert brightness("light") > 230
    assert brightness("dark") < 40


def test_a_fresh_board_says_that_it_prepares_and_then_shows_its_rows(opened, tmp_path):
    with (
        boards.create(tmp_path / "board", classes=1, references=False) as store,
        serving(store.folder.path) as url,
    ):
        admission.submit_references(store)
        page = opened(url)
        expect(page.get_by_text("Preparing.")).to_be_visible()
        for level in (0.0, 1.0):
            boards.score(store, [level] * 6)
        expect(page.get_by_role("row", name=re.compile("optimal"))).to_be_visible()  # by itself
        expect(page.get_by_text("Preparing.")).to_have_count(0)
