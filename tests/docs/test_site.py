"""The site as a reader sees it: built without a warning, whole without a network, at two widths."""

import html.parser
import json
import re

import pytest

from tests.browser import needs_chromium, serving_files
from tests.docs.conftest import ROOT, TUTORIALS

WIDTHS = {"phone": 400, "desktop": 1280}
SAMPLE = (
    "index", "tutorials/first_agent", "tutorials/sweep_figure", 
    "guides/studies", "guides/training", "explanation/method", "results/ablations",
    "reference/generated/catalogue", "reference/generated/catalogue-safety", "reference/sme",
    "reference/generated/files",
    "reference/python/sme_registry", "reference/python/sme_registry.spec", "genindex",
)  # fmt: skip


class Loaded(html.parser.HTMLParser):
    """What a page loads by itself, unlike what it links to."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if tag in ("script", "img", "iframe", "source"):
            self.addresses.append(values.get("src") or "")
        elif tag == "link" and values.get("rel") not in ("next", "prev", "index", "search"):
            self.addresses.append(values.get("href") or "")


def test_no_page_loads_anything_from_another_host(site):
    pages = sorted(site.rglob("*.html"))
    assert 40 < len(pages) <= 75
    for page in pages:
        parser = Loaded()
        parser.feed(page.read_text(encoding="utf-8"))
        outside = [a for a in parser.addresses if re.match(r"(https?:)?//", a)]
        assert outside == [], page
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", sheet.read_text()), sheet


def test_every_page_of_the_sources_is_in_the_site(site):
    hidden = {"_build", "_extensions", "python", "codes.md"}
    files = [p for ending in ("md", "ipynb") for p in (ROOT / "docs").rglob(f"*.{ending}")]
    sources = [p.relative_to(ROOT / "docs") for p in files]
    pages = [p for p in sources if not hidden.intersection(p.parts)]
    assert len(pages) > 40
    assert [p for p in pages if not (site / p).with_suffix(".html").exists()] == []


def test_a_schema_is_a_file_and_a_tutorial_a_notebook_with_its_figures(site):
    schema = json.loads((site / "schemas" / "SMESpec.schema.json").read_text())
    assert schema["properties"]["k"]["minimum"] == 1
    for name, source in TUTORIALS.items():
        page = (site / "tutorials" / f"{name}.html").read_text()
        (link,) = re.findall(rf'href="(\.\./_downloads/\w+/{name}\.ipynb)"', page)
        assert (site / "tutorials" / link).read_bytes() == source.read_bytes()
        figures = source.read_text(encoding="utf-8").count('"image/png"')
        assert len(re.findall(r'<img [^>]*src="\.\./_images/', page)) == figures


def test_names_and_commands_in_code_lead_to_their_reference(site):
    page = (site / "guides" / "training.html").read_text()
    assert re.search(r'href="\.\./reference/sme\.html#sme-train"', page)
    page = (site / "guides" / "studies.html").read_text()
    assert re.search(r'href="\.\./reference/python/sme_registry\.studies\.html#sme_reg', page)


@pytest.fixture(scope="module")
def origin(site):
    """The address at which the site is served: a search reads pages, which a file may not do."""
    with serving_files(site) as address:
        yield address


@pytest.fixture
def opened(chromium, origin):
    """Opens pages, and fails where one complained or asked for anything from another host."""
    contexts, problems = [], []

    def requested(request):
        if not request.url.startswith((origin, "data:")):
            problems.append(request.url)

    def complained(message):
        if message.type in ("error", "warning"):
            problems.append(f"{message.location['url']}: {message.text}")

    def open_(name, width="desktop", **options):
        size = {"width": WIDTHS[width], "height": 800}
        context = chromium.new_context(viewport=size, **options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(60_000)  # for machines with other things to do
        page.on("console", complained)
        page.on("pageerror", lambda error: problems.append(f"{page.url}: {error}"))
        page.on("request", requested)
        page.goto(f"{origin}{name}.html")
        return page

    yield open_
    for context in contexts:
        context.close()
    assert problems == []


@needs_chromium
@pytest.mark.parametrize("width", WIDTHS)
def test_no_page_is_wider_than_the_screen(origin, width, opened):
    page = opened("index", width)
    too_wide = {}
    for name in SAMPLE:
        page.goto(f"{origin}{name}.html")
        # On a phone, Furo's text scrolls within `.content`, and the document is never too wide.
        widths = "[document.documentElement, document.querySelector('.content')]"
        wide = max(page.evaluate(f"{widths}.map(element => element.scrollWidth)"))
        assert page.evaluate("window.innerWidth") == WIDTHS[width]
        if wide > WIDTHS[width]:
            too_wide[name] = wide
    assert too_wide == {}


@needs_chromium
def test_search_finds_a_word_and_leads_to_its_page(opened):
    page = opened("index")
    page.get_by_role("textbox", name="Search").fill("plasticity")
    page.keyboard.press("Enter")
    page.locator("ul.search li a", has_text="Streams: tasks that change").first.click()
    assert "/guides/streams.html" in page.url


@needs_chromium
def test_dark_is_dark_and_light_is_light_and_a_button_changes_it(opened):
    def brightness(page):
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return sum(map(int, re.findall(r"\d+", colour)[:3])) / 3

    light = opened("index", color_scheme="light")
    assert brightness(light) > 230
    assert brightness(opened("index", color_scheme="dark")) < 40
    light.locator("button.theme-toggle:visible").click()
    assert brightness(light) < 40
