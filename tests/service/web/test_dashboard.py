"""The page in a real Chromium: on panels, tablets and phones, by mouse and by keyboard."""

import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from service.contract import wire
from tests.service import tiny_models
from tests.service.client import Driver, greeted
from tests.service.conftest import LiveService

playwright = pytest.importorskip("playwright.sync_api", reason="playwright (extra `browser`) is not installed")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe (extra `browser`) is not installed")
CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync"]
SCREENSHOTS = os.environ.get("TACTILE_SCREENSHOTS")  # a folder: keep what the page looked like
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt-get install chromium)"),
]
PANELS = {"panel": (1280, 800), "monitor": (1920, 1080), "tablet": (820, 1180), "phone": (390, 844)}
PANELS |= {"small panel": (1024, 600), "zoomed": (960, 540)}
WAIT_MS, MOST_BYTES = 60_000, 300_000
REFUSED = "limits", "limits: target: target x_mm = 31.200, allowed -20 to 20"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Any, live: LiveService) -> Iterator[Any]:
    for alarm in httpx.get(live.url("/v1/status")).json()["alarms"]:  # what other tests left
        httpx.post(live.url(f"/v1/alarms/{alarm['number']}/acknowledge"))
    opened = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="light")
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


def says(page: Any, words: str) -> None:
    wait_until(page, f"document.getElementById('words').textContent.includes({json.dumps(words)})")


def insertion(live: LiveService, name: str, **hello: Any) -> Driver:
    driver = greeted(live, name, **hello)
    here = wire.ToolPose(x_mm=0.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)
    driver.send(wire.Episode(insertion_id=name, object="rectangle", start=here, approach=here))
    return driver


def tell_depth(driver: Driver, began_ns: int, ended_ns: int) -> None:
    """A robot's telemetry: down to 6 mm, and up again."""
    at_ns = [began_ns + k * (ended_ns - began_ns) // 60 for k in range(60)]
    depths_mm = [6.0 - abs(0.2 * k - 6.0) for k in range(60)]
    samples = [
        wire.RobotSample(at_ns=at, phase="descending", attempt=1, depth_mm=depth)
        for at, depth in zip(at_ns, depths_mm, strict=True)
    ]
    driver.send(wire.Telemetry(insertion_id=driver.id, sent_ns=ended_ns, samples=tuple(samples)))


def test_the_page_shows_an_insertion_as_it_happens_and_the_same_after_a_reload(live: LiveService, page: Any) -> None:
    wait_until(page, "document.getElementById('headline').className !== 'busy'")
    for finger in ("left", "right"):
        wait_until(page, f"document.getElementById('{finger}-state').textContent !== ''")
        assert colours(page, finger) > 50
    driver = insertion(live, "shown")
    moved = driver.attempt(1)
    says(page, "Attempt 1 of 15: moving to the corrected place")
    assert "slip begins" in page.locator("#left-state, #right-state").all_text_contents()
    words = page.locator("#move").text_content()
    assert f"{abs(moved.dx_mm):.1f} mm {'right' if moved.dx_mm > 0 else 'left'}" in words
    assert ("guessing the direction" in page.locator("#sure").text_content()) == (moved.confidence < 0.45)
    assert page.locator("#above .target").count() == 1
    assert page.locator("#above .ghost").count() > 10
    page.reload()
    says(page, "Attempt 1 of 15: moving to the corrected place")
    wait_until(page, "document.getElementById('above').querySelector('.target') !== null")
    assert page.locator("#move").text_content() == words
    keep(page, "dashboard")
    assert driver.insert(2).outcome == "inserted"
    driver.close()
    says(page, "Rectangle inserted after 2 attempts")
    page.reload()
    says(page, "Rectangle inserted after 2 attempts")
    assert page.problems == []


def test_a_failure_is_latched_until_it_is_acknowledged(live: LiveService, page: Any) -> None:
    driver = insertion(live, "dropped")
    driver.attempt(1)
    driver.gives_up("part_lost", "gripper: part_lost: width 3.1 mm, held 40.2 mm")
    says(page, "Holding: the object slipped out of the fingers")
    page.reload()
    says(page, "Holding: the object slipped out of the fingers")
    assert page.locator("#open-alarms.stop").text_content() == "1"
    keep(page, "dashboard_fault")
    page.get_by_role("button", name="Acknowledge", exact=True).click()
    says(page, "Ready for the next object")
    wait_until(page, "document.getElementById('open-alarms').textContent === ''")
    assert "acknowledged" in page.locator("#alarms li").first.text_content()
    assert page.problems == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("panel", PANELS)
def test_nothing_is_cut_off_or_hard_to_use(live: LiveService, browser: Any, panel: str, scheme: Any) -> None:
    """No horizontal scrolling, on a panel no scrolling at all, and nothing that axe calls critical or serious."""
    width, height = PANELS[panel]
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
    driver = insertion(live, f"fits-{panel}-{scheme}".replace(" ", "-"))
    try:
        driver.attempt(1)
        for view in ("live", "history"):
            page.goto(live.url(f"/#{view}"))
            says(page, "Attempt 1 of 15")
            check_fits(page, panel, height)
            if view == "live" and (panel == "phone" or (panel, scheme) == ("monitor", "dark")):
                keep(page, f"dashboard_{panel}")
    finally:
        driver.gives_up()
        page.close()


def check_fits(page: Any, panel: str, height: int) -> None:
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    if panel in {"panel", "small panel", "monitor"}:
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
        boxes = [section.bounding_box() for section in page.locator("main section:visible").all()]
        assert max(box["y"] + box["height"] for box in boxes) <= height
    violations = axe.Axe().run(page).response["violations"]
    assert [
        (one["id"], one["nodes"][0]["html"]) for one in violations if one["impact"] in {"critical", "serious"}
    ] == []
    clipped = "e => e.offsetParent && e.scrollHeight > e.clientHeight + 1"
    assert not page.evaluate(f"[...document.querySelectorAll('.next, .place')].some({clipped})")


def test_the_page_is_light_and_needs_no_other_server(live: LiveService, browser: Any) -> None:
    page = browser.new_page()
    loaded: dict[str, int] = {}
    page.on("response", lambda r: loaded.__setitem__(r.url, len(r.body())) if "/v1/" not in r.url else None)
    page.goto(live.url("/#history"))
    wait_until(page, "document.getElementById('count').textContent !== ''")
    page.wait_for_timeout(500)
    page.close()
    assert {urlsplit(url).netloc for url in loaded} == {f"127.0.0.1:{live.port}"}
    assert sum(loaded.values()) <= MOST_BYTES, loaded


def test_a_past_insertion_is_found_and_played_back_with_the_keyboard_alone(live: LiveService, page: Any) -> None:
    for name in ("keys", "other", "another"):
        driver = insertion(live, name)
        began_ns = time.monotonic_ns()
        driver.attempt(1)
        tell_depth(driver, began_ns, time.monotonic_ns())
        driver.gives_up(*(["operator"] if name == "keys" else REFUSED))
    page.route("**/uPlot.iife.min.js", lambda route: (page.wait_for_timeout(500), route.continue_()))
    page.goto(live.url("/#history"))
    page.evaluate("window.dispatchEvent(new HashChangeEvent('hashchange'))")  # while the charts' library is on its way
    wait_until(page, "document.querySelectorAll('#past tr').length >= 2")
    wait_until(page, "document.querySelectorAll('#trend canvas').length === 3")
    keep(page, "dashboard_history")
    page.get_by_label("Cause").select_option("limits")
    wait_until(page, "[...document.querySelectorAll('#past tr')].every(r => r.textContent.includes('limits'))")
    page.get_by_label("Cause").select_option("operator")
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.getAttribute('aria-label')") == "play back keys":
            break
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keyboard.press("Enter")
    wait_until(page, "document.querySelectorAll('#curves canvas').length === 3")
    page.locator("#scrub").focus()
    page.keyboard.press("End")
    wait_until(page, "document.getElementById('then').textContent.includes(' s ')")
    wait_until(page, "/slip|slides|holds|edge/.test(document.getElementById('left-then-state').textContent)")
    assert colours(page, "left-then") > 50
    for _ in range(8):
        page.keyboard.press("ArrowLeft")
    wait_until(page, "document.getElementById('right-then-state').textContent !== ''")
    page.wait_for_timeout(500)
    keep(page, "dashboard_playback")
    page.locator("#again").focus()
    page.keyboard.press("Enter")
    wait_until(page, "document.getElementById('answer').textContent.includes('all the same bit for bit')")
    page.keyboard.press("Escape")
    wait_until(page, "!document.getElementById('player').open")
    assert page.problems == []


def test_a_cut_camera_is_seen_at_once_and_stays_an_alarm(live: LiveService, page: Any) -> None:
    wait_until(page, "document.querySelectorAll('#health .good').length >= 2")
    live.fingers[1].connected = False
    says(page, "No picture from the right camera")
    assert page.locator("#health .bad").first.text_content().startswith("right")
    wait_until(page, "document.getElementById('right-state').textContent === 'no picture'")
    live.fingers[1].connected = True
    page.get_by_text(re.compile(r"right \d+ Hz")).wait_for()
    wait_until(page, "document.getElementById('right-state').textContent !== 'no picture'")
    wait_until(page, "document.getElementById('headline').className === 'good'")
    assert "gone, not acknowledged" in page.locator("#alarms li").first.text_content()
    assert page.locator("#open-alarms.stop").count() == 0, "red is for what holds the arm"
    page.get_by_role("button", name=re.compile("acknowledge: Right camera")).click()
    wait_until(page, "document.getElementById('open-alarms').textContent === ''")
    assert page.request.get(live.url("/favicon.ico")).status == 200
    assert page.problems == []


def test_the_policy_stops_what_is_not_ours(live: LiveService, page: Any, browser: Any) -> None:
    """A script that got into the page does not run, and a foreign page may not frame ours."""
    wait_until(page, "document.getElementById('headline').className === 'good'")
    page.evaluate("""() => { const s = document.createElement("script"); s.textContent = "window.ran = 1";
      document.body.append(s); }""")
    assert page.evaluate("window.ran") is None
    assert any("Content Security Policy" in problem for problem in page.problems)
    foreign = browser.new_page()
    foreign.set_content(f'<iframe src="{live.url("/")}"></iframe>')
    foreign.wait_for_timeout(1000)
    assert foreign.frames[1].locator("#words").count() == 0
    foreign.close()


@pytest.mark.parametrize("panel", ["panel", "phone"])
def test_versions_beside_are_shown_small_with_their_evidence(
    live: LiveService, browser: Any, panel: str, tmp_path: Path
) -> None:
    shadow = tiny_models.write_models(tmp_path / "shadow", git_commit=panel.ljust(40, "0"))
    width, height = PANELS[panel]
    page = browser.new_page(viewport={"width": width, "height": height})
    page.goto(live.url("/"))
    asked = {"params": {"folder": str(shadow)}, "headers": live.bearer}
    httpx.post(live.url("/v1/versions/shadow"), **asked).raise_for_status()
    try:
        state = httpx.get(live.url("/v1/versions")).json()
        shown = page.locator("#health").get_by_text(f"shadow {state['shadow']['version'][:6]}: 1.0 of 20 after 0")
        playwright.expect(shown).to_be_visible(timeout=WAIT_MS)
        playwright.expect(page.locator("#health")).to_contain_text(f"version {state['active']['version'][:6]} decides")
        check_fits(page, panel, height)
    finally:
        httpx.delete(live.url("/v1/versions/shadow"), headers=live.bearer)
        page.close()
