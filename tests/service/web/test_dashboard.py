"""The page in a real Chromium, at the size of a 1080p panel: what it shows, by mouse and by keyboard."""

import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.contract import wire
from tests.service.client import Driver
from tests.service.conftest import LiveService

playwright = pytest.importorskip("playwright.sync_api", reason="playwright (extra `browser`) is not installed")
CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync"]
SCREENSHOTS = os.environ.get("TACTILE_SCREENSHOTS")  # a folder: keep what the page looked like
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt-get install chromium)"),
]
WAIT_MS = 60_000
READABLE_PX = 22  # cap heights of 16 px and up are ten minutes of arc on a 24 inch panel two metres away


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Any, live: LiveService) -> Iterator[Any]:
    opened = browser.new_page(viewport={"width": 1920, "height": 1080})
    opened.set_default_timeout(WAIT_MS)
    opened.problems = []
    opened.on("console", lambda m: opened.problems.append(m.text) if m.type == "error" else None)
    opened.on("pageerror", lambda error: opened.problems.append(str(error)))
    opened.on("response", lambda r: opened.problems.append(f"{r.status} {r.url}") if r.status >= 400 else None)
    opened.goto(live.url("/"))
    yield opened
    opened.close()


def keep(page: Any, name: str) -> None:
    if SCREENSHOTS:
        page.screenshot(path=Path(SCREENSHOTS) / f"{name}.png")


def colours(page: Any, canvas: str) -> int:
    """How many different colours a canvas shows."""
    return page.evaluate(
        """id => { const c = document.getElementById(id);
          const d = new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer);
          return new Set(d).size; }""",
        canvas,
    )


def wait_until(page: Any, holds: str) -> None:
    """Poll an expression from outside: the browser's own way evaluates text, which the page's policy forbids."""
    deadline = time.monotonic() + WAIT_MS / 1e3
    while not page.evaluate(holds):
        assert time.monotonic() < deadline, holds
        page.wait_for_timeout(30)


def insertion(live: LiveService, name: str) -> Driver:
    driver = Driver(live, name)
    driver.until("hello")
    return driver


def test_the_page_shows_an_insertion_as_it_happens(live: LiveService, page: Any) -> None:
    wait_until(page, "document.getElementById('status').textContent === 'ready'")
    for finger in ("left", "right"):
        wait_until(page, f"document.getElementById('{finger}-state').textContent !== ''")
        assert colours(page, finger) > 500
    driver = insertion(live, "shown")
    page.get_by_text("robot shown").wait_for()
    plane = colours(page, "plane")
    driver.attempt(1)
    page.get_by_text(re.compile("Move [+-]")).wait_for()
    assert page.locator("#bars .bar").count() == 9
    assert page.locator("#bars .bar.best").count() == 1
    assert page.locator("#latency .bar").count() >= 5
    assert colours(page, "plane") > plane
    keep(page, "dashboard_decision")
    driver.attempt(2)
    page.get_by_text("Attempt 2: corrected").wait_for()
    page.get_by_text(re.compile(r"slip 1\.|slip [2-9]")).first.wait_for()
    page.get_by_text("attempt 2: slip").wait_for()
    keep(page, "dashboard")
    assert driver.insert(3).outcome == "inserted"
    page.get_by_text("inserted, 3 attempts", exact=True).wait_for()
    driver.close()
    assert page.problems == []


def test_a_past_insertion_is_played_back_with_the_keyboard_alone(live: LiveService, page: Any) -> None:
    driver = insertion(live, "keys")
    driver.attempt(1)
    driver.send(wire.Abort(insertion_id="keys", cause="operator", reason="done"))
    driver.until("finished")
    driver.close()
    page.get_by_role("button", name=re.compile("keys")).wait_for()
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent").endswith("keys"):
            break
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid"
    page.keyboard.press("Enter")
    wait_until(page, "document.getElementById('player').open")
    wait_until(page, "document.getElementById('still').naturalWidth > 600")
    wait_until(page, "document.getElementById('past-decision').textContent.startsWith('correction')")
    page.locator("#scrub").focus()
    page.keyboard.press("ArrowRight")
    page.get_by_text("frame 2", exact=True).wait_for()
    page.locator("#play").focus()
    page.keyboard.press("Space")
    page.get_by_text("frame 8", exact=True).wait_for()
    keep(page, "dashboard_playback")
    page.keyboard.press("Escape")
    wait_until(page, "!document.getElementById('player').open")
    assert page.problems == []


def test_everything_fits_a_panel_and_can_be_read_from_two_metres(live: LiveService, page: Any) -> None:
    driver = insertion(live, "read")
    driver.attempt(1)
    page.get_by_text(re.compile("Move [+-]")).wait_for()
    assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    sizes = page.evaluate(
        """[...document.querySelectorAll("body *")].filter(e => e.offsetParent && [...e.childNodes].some(n =>
          n.nodeType === 3 && n.textContent.trim()))
          .map(e => [parseFloat(getComputedStyle(e).fontSize), e.textContent])"""
    )
    assert min(size for size, _ in sizes) >= READABLE_PX, sorted(sizes)[:5]
    assert page.evaluate("parseFloat(getComputedStyle(document.getElementById('status')).fontSize)") >= 48
    for section in page.locator("main section").all():
        box = section.bounding_box()
        assert box["y"] + box["height"] <= 1080
    clipped = page.evaluate(
        """[...document.querySelectorAll("section")].filter(s => s.scrollHeight > s.clientHeight + 1)
          .map(s => `${s.className} ${s.scrollHeight} in ${s.clientHeight}`)"""
    )
    assert clipped == []
    driver.send(wire.Abort(insertion_id="read", cause="operator", reason="done"))
    driver.until("finished")
    driver.close()


def test_dropped_frames_are_red_while_they_grow_and_not_for_ever(live: LiveService, page: Any) -> None:
    dropped = page.locator("#health li").last
    wait_until(page, "document.querySelectorAll('#health li').length === 4")
    live.station.counters.frames_dropped_n += 7
    wait_until(page, "document.querySelector('#health li:last-child').className === 'bad'")
    page.evaluate("const now = Date.now; Date.now = () => now() + 61_000")
    wait_until(page, "document.querySelector('#health li:last-child').className === 'good'")
    assert dropped.text_content() == f"dropped {live.station.counters.frames_dropped_n}"


def test_a_cut_camera_is_seen_at_once_and_nothing_is_missing(live: LiveService, page: Any) -> None:
    wait_until(page, "document.querySelectorAll('#health .good').length >= 2")
    live.fingers[1].connected = False
    wait_until(page, "document.getElementById('status').textContent === 'cameras not live'")
    assert page.locator("#health .bad").first.text_content().startswith("right")
    keep(page, "dashboard_fault")
    live.fingers[1].connected = True
    page.get_by_text(re.compile(r"right \d+ Hz")).wait_for()
    wait_until(page, "document.getElementById('status').textContent === 'ready'")
    assert page.request.get(live.url("/favicon.ico")).status == 200
    assert page.problems == []


def test_the_policy_stops_what_is_not_ours(live: LiveService, page: Any, browser: Any) -> None:
    """A script that got into the page does not run, and a foreign page may not frame ours."""
    wait_until(page, "document.getElementById('status').textContent === 'ready'")
    page.evaluate("""() => { const s = document.createElement("script"); s.textContent = "window.ran = 1";
      document.body.append(s); }""")
    assert page.evaluate("window.ran") is None
    assert any("Content Security Policy" in problem for problem in page.problems)
    foreign = browser.new_page()
    foreign.set_content(f'<iframe src="{live.url("/")}"></iframe>')
    foreign.wait_for_timeout(1000)
    assert foreign.frames[1].locator("#status").count() == 0
    foreign.close()
