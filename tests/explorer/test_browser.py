"""Pages in a real browser: their numbers are Python's, and every control does what it says."""

import numpy as np
import pytest
from playwright.sync_api import expect

from sme_registry import SMESpec, load, materialize
from sme_registry.diagnosis import load_policy
from sme_registry.evaluation import evaluate
from sme_registry.explorer import write_explorer
from tests.browser import needs_chromium
from tests.explorer.networks import fitted, observations, offline, perceptron

pytestmark = needs_chromium
expect.set_options(timeout=30_000)

TOLERANCE = 1e-5
HOSTILE = "</script><img src=x onerror=alert(1)><b>bold"
SPEC = SMESpec(state_dim=4, action_dim=2, complexity=2)
TASK = materialize(SPEC)


@pytest.fixture
def opened(chromium):
    """Opens pages, and fails where one complained or asked for anything but itself."""
    contexts, problems, requests = [], [], []

    def open_(path, width=1280, **options):
        context = chromium.new_context(viewport={"width": width, "height": 900}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("dialog", lambda dialog: (problems.append("a dialog"), dialog.dismiss()))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        return ready(page)

    yield open_
    for context in contexts:
        context.close()
    assert problems == []
    assert [url for url in requests if not url.startswith("file:")] == []
    assert len(requests) == len(contexts)


def ready(page):
    # Not `wait_for_function`, which evaluates text, as the page forbids.
    expect(page.locator("html")).to_have_attribute("data-ready", "true")
    return page


def written(folder, spec, policy=None, **options):
    subject = spec if policy is None else load_policy(policy, spec, name="the policy")
    return write_explorer(folder / "page.html", subject, episodes=8, **options)


def points_of(shown):
    """The points of a map `[n², inputs]`, as the page says where it lies."""
    n, (i, j) = shown["n"], shown["axes"]
    points = np.tile(shown["point"], (n * n, 1))
    points[:, i] = np.tile(np.linspace(shown["low"][0], shown["high"][0], n), n)
    points[:, j] = np.repeat(np.linspace(shown["low"][1], shown["high"][1], n), n)
    return points


def set_slider(page, name, value):
    page.get_by_role("slider", name=name, exact=True).evaluate(
        "(slider, value) => { slider.value = value; slider.dispatchEvent(new Event('input')); }",
        str(value),
    )
    ready(page)


def map_of(page):
    """What the page shows, and its points."""
    ready(page)
    shown = page.evaluate("explorer.map()")
    return shown, points_of(shown)


def choose(page, label, option):
    page.get_by_label(label).select_option(option)
    return map_of(page)


@pytest.mark.parametrize(
    ("name", "action_range"),
    [
        ("MinReward50", "unit"),
        ("Team2", "unit"),
        ("HardSafeMixed", "symmetric"),
    ],
)
def test_a_map_is_the_tasks_regret(name, action_range, tmp_path, opened):
    spec = load(name, SMESpec)
    if spec.team is None:
        policy = fitted(spec, squashed=action_range == "symmetric")
    else:
        policy = {each.name: fitted(spec, agent=i) for i, each in enumerate(spec.team.agents)}
    subject = load_policy(policy, spec, action_range=action_range)
    page = opened(write_explorer(tmp_path / "page.html", subject, episodes=8))
    set_slider(page, "state channel 3", 0.8)
    set_slider(page, "time t/T", 0.25)
    shown, points = choose(page, "Across", "s4")
    assert (shown["n"], shown["axes"]) == (101, [3, 1])
    assert (shown["low"], shown["high"]) == ([-0.5, -0.5], [1.5, 1.5])
    assert shown["point"][2] == 0.8

    task, s = materialize(spec), points[:, : spec.state_dim]
    a = np.clip(subject.policy(observations(spec, points)), 0.0, 1.0)
    regret = task.regret(s, a)
    assert 0.05 < regret.mean() < 0.99
    assert regret.std() > 0.01
    np.testing.assert_allclose(shown["values"], regret, atol=TOLERANCE)

    some = points[:: 101 * 7 + 3]
    here = page.evaluate("points => explorer.at(points)", some.tolist())
    optimal = np.reshape(here["optimal"], (len(some), -1))
    np.testing.assert_allclose(optimal, task.optimal_action(some[:, : spec.state_dim]), atol=1e-6)
    if spec.safety is not None:
        cost = choose(page, "Show", "cost")[0]["values"]
        np.testing.assert_allclose(cost, task.cost(s, a), atol=TOLERANCE)
        safe = choose(page, "Show", "safe regret")[0]["values"]
        expected = task.step_reward(s, task.safe_action(s)) - task.step_reward(s, a)
        np.testing.assert_allclose(safe, expected, atol=TOLERANCE)


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    """The page of a policy whose network is known."""
    return written(tmp_path_factory.mktemp("page"), SPEC, fitted(SPEC))


def test_every_control_is_reached_and_used_by_keyboard(page_file, opened):
    page = opened(page_file)
    assert map_of(page)[0]["point"][:2] != [0.5, 0.5]  # where each optimum is ½
    page.locator("#centre").evaluate("button => button.click()")  # which leaves the focus
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the map")).to_be_focused()
    surface = page.get_by_role("application", name="Map")
    for _ in range(12):
        page.keyboard.press("Tab")
        if surface.evaluate("e => e === document.activeElement"):
            break
    expect(surface).to_be_focused()
    assert surface.evaluate("e => getComputedStyle(e).outlineStyle") == "solid"
    before = page.locator("#reading").inner_text()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowUp")
    assert map_of(page)[0]["point"][:2] == pytest.approx([0.52, 0.7])
    assert page.locator("#reading").inner_text() != before
    expect(page.get_by_role("status")).to_contain_text("s1 = 0.52, s2 = 0.70")
    for _ in range(4):
        page.keyboard.press("Shift+ArrowUp")
    expect(page.get_by_role("status")).to_contain_text("outside the cube, at ε = 1.00")

    values = map_of(page)[0]["values"]
    page.get_by_role("slider", name="state channel 3", exact=True).focus()
    page.keyboard.press("ArrowRight")
    shown, _ = map_of(page)
    assert shown["point"][2] == pytest.approx(0.51)
    assert shown["values"] != values
    tree = page.locator("body").aria_snapshot()
    assert '- slider "state channel 3"' in tree
    for role in ("slider", "combobox", "checkbox", "button", "application"):
        assert f"- {role}:" not in tree, "a control without a name"


def test_the_map_follows_its_controls(page_file, opened):
    page = opened(page_file)
    choose(page, "Show", "optimal action")
    shown, points = choose(page, "Action channel", "2")
    optimal = TASK.optimal_action(points[:, :4])
    np.testing.assert_allclose(shown["values"], optimal[:, 1], atol=1e-8)
    set_slider(page, "Beyond the cube, ε", 0.4)
    assert map_of(page)[0]["low"] == pytest.approx([-0.2, -0.2])
    choose(page, "Show", "regret")
    shown, points = choose(page, "Policy", "constant ½")
    regret = TASK.regret(points[:, :4], np.full((len(points), 2), 0.5))
    np.testing.assert_allclose(shown["values"], regret, atol=1e-8)
    box = page.locator("#surface").bounding_box()
    page.mouse.click(box["x"] + 0.75 * box["width"], box["y"] + 0.25 * box["height"])
    assert map_of(page)[0]["point"][:2] == pytest.approx([0.85, 0.85], abs=0.02)
    page.get_by_role("button", name="Centre").click()
    assert map_of(page)[0]["point"][:2] == [0.5, 0.5]


def test_a_policy_of_an_unknown_network_is_sampled_and_the_page_says_so(tmp_path, opened):
    def act(o):
        return np.abs(np.sin(3.0 * o[:, [0, 2]]))

    page = opened(written(tmp_path, SPEC, act, channels=[(1, 2), (3, 2)]))
    last = page.get_by_role("slider", name="state channel 4", exact=True)
    expect(page.locator("#notice")).to_contain_text("sampled over s1 and s2; s3 and s2")
    expect(last).to_be_disabled()
    expect(page.get_by_role("slider", name="state channel 2", exact=True)).to_be_enabled()
    for across in ("s1", "s3"):
        shown, points = choose(page, "Across", across)
        regret = TASK.regret(points[:, :4], act(observations(SPEC, points)))
        np.testing.assert_allclose(shown["values"], regret, atol=TOLERANCE)
    choose(page, "Policy", "linear")
    expect(page.locator("#notice")).to_be_hidden()
    expect(last).to_be_enabled()


def test_a_task_of_one_channel_has_a_map_over_time(tmp_path, opened):
    spec = SMESpec(state_dim=1, action_dim=1)
    shown, _ = map_of(opened(written(tmp_path, spec, offline(spec))))
    assert (shown["axes"], shown["low"]) == ([0, 1], [-0.5, 0])

    def act(o):
        return np.abs(np.sin(3.0 * o[:, :1] + 5.0 * o[:, 1:2]))

    page = opened(written(tmp_path, spec, act))
    shown, points = choose(page, "Show", "regret")
    regret = materialize(spec).regret(points[:, :1], act(observations(spec, points)))
    np.testing.assert_allclose(shown["values"], regret, atol=TOLERANCE)


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_no_page_is_wider_than_the_screen(tmp_path, opened):
    spec = load("HardSafeMixed", SMESpec)
    policy = perceptron(spec)
    report = evaluate(policy, spec, {"states_per_region": 200})
    path = written(tmp_path, spec, policy, report=report)
    for width, scheme in ((1280, "light"), (360, "dark")):
        page = opened(path, width, color_scheme=scheme)
        wide, screen = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
        assert wide <= screen == width
        headings = page.get_by_role("heading", level=2).all_inner_texts()
        assert {"Inside and outside the cube", "What the layers keep"} <= set(headings)
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (int(colour.split("(")[1].split(",")[0]) > 128) == (scheme == "light")


def test_a_hostile_name_is_a_name(tmp_path, opened):
    spec = SMESpec(state_dim=2, action_dim=1).named(HOSTILE)
    subject = load_policy(perceptron(spec), spec, name=HOSTILE)
    page = opened(write_explorer(tmp_path / "page.html", subject, episodes=8))
    assert page.evaluate("document.querySelectorAll('b, img').length") == 0
    expect(page.get_by_role("heading", level=1)).to_contain_text("<img src=x")
    expect(page.locator("#reading")).to_contain_text(HOSTILE)


def test_the_page_may_load_and_run_nothing_else(page_file, chromium):
    page = chromium.new_page()
    heard = []
    page.on("console", lambda message: heard.append(message.text))
    page.goto(page_file.as_uri())
    ready(page)
    assert heard == []
    for code in (
        "document.body.append(Object.assign(document.createElement('script'), {text: '1'}))",
        "document.body.append(Object.assign(new Image(), {src: 'data:,'}))",
        "fetch('http://127.0.0.1:9/').catch(() => 0)",
    ):
        with page.expect_console_message():
            page.evaluate(code)
    page.close()
    assert all("Content Security Policy" in text for text in heard)
    assert len(heard) >= 3
