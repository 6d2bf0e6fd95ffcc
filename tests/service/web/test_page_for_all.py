"""The page in a real Chromium for people who see no colours, use a keyboard or a screen reader, or wear gloves."""

import base64
import json
import re
from contextlib import closing
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from simulation.studies.motion_bounds.relay import Relay
from tests.service.conftest import LiveService
from tests.service.web import test_dashboard
from tests.service.web.test_dashboard import insertion, says, wait_until

browser, page, pytestmark = test_dashboard.browser, test_dashboard.page, test_dashboard.pytestmark
PLAYED = "document.querySelectorAll('#curves canvas').length === 3"
FOCUSED = "document.activeElement.ariaLabel"
GRAPHICS_LEAST = 3.0  # contrast of graphics, WCAG 2.2, 1.4.11
FINGER_PX = 40
LONG_PX = 48


def grey(page: Any, kind: int, size: tuple[int, int] = (490, 480)) -> NDArray[np.int16]:
    """The page's own drawing of one marker that moved up by ``LONG_PX``, as eyes see it that see no colours.

    The marker is in the middle of a frame of this width and height.
    """
    width, height = size
    jpeg = base64.b64encode(cv2.imencode(".jpg", np.full((height, width), 90, np.uint8))[1].tobytes()).decode()
    content = {"width": width, "height": height, "jpeg": jpeg, "state": "contact", "score": 0.0, "kinds": [kind]}
    content |= {"rest": [width / 2, height / 2], "moved": [0, -LONG_PX / 4 * width / 490]}  # enlarged 4 times
    shown: str = page.evaluate(
        """async content => { const { drawFelt } = await import("/dashboard/felt.js");
          const canvas = Object.assign(document.createElement("canvas"), { width: 490, height: 480 });
          const caption = document.createElement("p");
          drawFelt(canvas, caption, content);
          await new Promise(done => setTimeout(done, 500));
          return canvas.toDataURL("image/png"); }""",
        content,
    )
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(shown.partition(",")[2]), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    return pixels.astype(np.int16)


def test_which_markers_slip_is_told_by_shape(page: Any) -> None:
    """Outside the contact a dashed arrow, in contact a solid one, where it slips one from a square spot."""
    nothing = grey(page, -1)
    shapes = {}
    for kind, name in enumerate(("outside", "sticks", "slips")):
        wide_px = (np.abs(grey(page, kind) - nothing) > 20).sum(axis=1)  # row by row, from the tip down to the tail
        head, shaft, tail = wide_px[240 - LONG_PX : 252 - LONG_PX], wide_px[252 - LONG_PX : 234], wide_px[234:246]
        assert head.max() >= 5, f"{name}: where it moved to has a head"
        shapes[name] = ("solid" if shaft.all() else "dashed", "spot" if tail.max() >= 5 else "")
    assert shapes == {"outside": ("dashed", ""), "sticks": ("solid", ""), "slips": ("solid", "spot")}


@pytest.mark.parametrize(("size", "middle"), [((490, 480), 240), ((320, 240), 184), ((245, 490), 490)])
def test_arrows_lie_on_their_markers_whatever_the_frame(page: Any, size: tuple[int, int], middle: int) -> None:
    rows = np.flatnonzero((np.abs(grey(page, 1, size) - grey(page, -1, size)) > 20).any(axis=1))
    assert (rows.min(), rows.max()) == (pytest.approx(middle - LONG_PX, abs=5), pytest.approx(middle, abs=5))


def test_the_curve_of_one_finger_does_not_hide_the_others(live: LiveService, page: Any) -> None:
    """Both fingers felt the same here: of a solid line below another solid one nothing would be left."""
    insertion(live, "curves").after(1).gives_up()
    page.goto(live.url("/#history"))
    page.get_by_label("play back curves", exact=True).click()
    wait_until(page, PLAYED)
    page.wait_for_timeout(500)
    left, right = page.evaluate(
        """() => { const c = document.querySelector("#curves canvas");
          const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data, n = [0, 0];
          for (let i = 0; i < d.length; i += 4) { if (d[i + 3] < 250) continue;
            if (d[i] < 60 && d[i + 2] > 150) n[0] += 1; if (d[i] > 120 && d[i + 2] < 40) n[1] += 1; }
          return n; }"""
    )
    assert min(left, right) > 20
    assert "right dashed" in page.locator("#curves .chart-title").first.text_content()
    assert page.problems == []


def test_curves_follow_a_window_that_is_resized_while_they_are_open(live: LiveService, page: Any) -> None:
    insertion(live, "resized").after(1).gives_up()
    page.set_viewport_size({"width": 1600, "height": 900})
    page.goto(live.url("/#history"))
    page.get_by_label("play back resized", exact=True).click()
    wait_until(page, PLAYED)
    for width_px in (900, 1400):
        page.set_viewport_size({"width": width_px, "height": 900})
        wait_until(
            page,
            "[...document.querySelectorAll('#curves .u-wrap')]"
            ".every(plot => Math.abs(plot.offsetWidth - document.getElementById('curves').clientWidth) < 2)",
        )


def test_an_amber_sentence_says_which_picture_is_missing(live: LiveService, page: Any) -> None:
    driver = insertion(live, "blind")
    driver.attempt(1)
    live.fingers[1].connected = False
    try:
        wait_until(page, "document.getElementById('headline').className === 'warning'")
        assert page.locator("#words").text_content().startswith("Attempt 1 of 15")
        assert "No picture from the right camera" in page.locator("#detail").text_content()
    finally:
        live.fingers[1].connected = True
        driver.gives_up()
    page.get_by_text(re.compile(r"right \d+ Hz")).wait_for()


def test_without_a_link_nothing_looks_alive_and_nothing_is_offered(live: LiveService, browser: Any) -> None:
    """An alarm is open as the link is cut: pressing Acknowledge then would do nothing, and nobody would know."""
    insertion(live, "cut").gives_up("part_lost", "width 3.1 mm")
    with closing(Relay.to(live.url(""))) as relay, closing(browser.new_page()) as page:
        page.goto(f"{relay.url}/")
        says(page, "Holding")
        page.get_by_role("button", name="Acknowledge", exact=True).wait_for()
        relay.misbehave("half open")
        says(page, "no connection to the service")
        assert page.locator("#health").text_content() == "not connected"
        assert page.locator("#health .good").count() == 0
        assert not page.locator("#acknowledge").is_visible()
        assert page.locator("#alarms button:enabled").count() == 0
        relay.misbehave("fair")
        page.get_by_role("button", name="Acknowledge", exact=True).wait_for()
        assert page.locator("#alarms button:enabled").count() > 0


def test_a_screen_reader_says_the_remedy_once(live: LiveService, page: Any) -> None:
    insertion(live, "announced").gives_up("part_lost", "width 3.1 mm")
    says(page, "Holding")
    announced = page.locator("[role=status], [aria-live]")
    assert announced.filter(has_text="Holding").first.get_attribute("aria-live") == "assertive"
    assert announced.filter(has_text="Pick it up by hand").count() == 1
    assert announced.filter(has_text=re.compile(r"^Alarms \d")).count() == 1
    page.evaluate("""() => { window.again = 0; const count = new MutationObserver(() => { window.again += 1; });
      for (const e of document.querySelectorAll("#live [aria-live], #headline [role=status]"))
        count.observe(e, { childList: true, characterData: true, subtree: true }); }""")
    page.wait_for_timeout(2500)
    assert page.evaluate("window.again") == 0, "what has not changed is not announced again"


def test_the_keyboard_is_never_nowhere(live: LiveService, page: Any) -> None:
    insertion(live, "first").gives_up("part_lost", "width 3.1 mm")
    says(page, "Holding")
    page.locator("#acknowledge").focus()
    page.keyboard.press("Enter")
    says(page, "Ready for the next object")
    assert page.evaluate("document.activeElement.id") == "words"
    page.goto(live.url("/#history"))
    page.get_by_label("play back first", exact=True).focus()
    insertion(live, "second").gives_up()
    page.get_by_label("play back second", exact=True).wait_for()
    assert page.evaluate(FOCUSED) == "play back first", "a row came in above it"
    page.keyboard.press("Enter")
    wait_until(page, PLAYED)
    insertion(live, "third").gives_up()
    page.get_by_label("play back third", exact=True).wait_for(state="attached")
    page.keyboard.press("Escape")
    wait_until(page, "!document.getElementById('player').open")
    wait_until(page, f"{FOCUSED} === 'play back first'")


@pytest.mark.parametrize("panel", ["panel", "small panel", "phone"])
def test_a_gloved_finger_hits_what_it_presses(live: LiveService, browser: Any, panel: str) -> None:
    name = f"glove-{panel}".replace(" ", "-")
    insertion(live, name).gives_up("part_lost", "width 3.1 mm")
    width, height = test_dashboard.PANELS[panel]
    with closing(browser.new_page(viewport={"width": width, "height": height})) as page:
        page.goto(live.url("/"))
        says(page, "Holding")
        page.locator("#alarms button").first.wait_for()
        assert too_small(page) == []
        page.goto(live.url("/#history"))
        page.get_by_label(f"play back {name}", exact=True).wait_for()
        assert too_small(page) == []
        page.get_by_label(f"play back {name}", exact=True).click()
        wait_until(page, PLAYED)
        assert too_small(page) == []
        for control in ("#play", "#close"):
            box = page.locator(control).bounding_box()
            assert box["y"] + box["height"] <= height, f"{control} is reached without scrolling"


def too_small(page: Any) -> list[str]:
    pressed = json.dumps("a, button, select, input, summary")
    shown: list[str] = page.evaluate(
        f"""() => [...document.querySelectorAll({pressed})].filter(e => e.checkVisibility())
          .filter(e => Math.min(e.offsetWidth, e.offsetHeight) < {FINGER_PX}).map(e => e.outerHTML)"""
    )
    return shown


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_blocks_stand_out_from_their_ground(page: Any, scheme: Any) -> None:
    page.emulate_media(color_scheme=scheme)
    edge = page.evaluate("getComputedStyle(document.querySelector('#side .block')).stroke")
    ground = page.evaluate("getComputedStyle(document.querySelector('.place')).backgroundColor")
    lighter, darker = sorted((luminance(edge), luminance(ground)), reverse=True)
    assert (lighter + 0.05) / (darker + 0.05) >= GRAPHICS_LEAST


def luminance(rgb: str) -> float:
    """Relative luminance of a CSS colour, WCAG 2.2."""
    parts = np.array([int(part) for part in re.findall(r"\d+", rgb)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_a_long_move_fits_on_the_smallest_panel(live: LiveService, page: Any) -> None:
    page.set_viewport_size(dict(zip(("width", "height"), test_dashboard.PANELS["small panel"], strict=True)))
    driver = insertion(live, "long")
    driver.attempt(1)
    says(page, "Attempt 1 of 15")
    assert page.evaluate(
        """([words, move, felt]) => { const at = id => document.getElementById(id);
          [at("words").textContent, at("move").textContent, at("felt").textContent] = [words, move, felt];
          const fits = e => e.scrollWidth <= e.clientWidth && e.scrollHeight <= e.clientHeight + 1;
          return [at("words"), document.querySelector(".next"), document.documentElement].every(fits); }""",
        [
            "Attempt 12 of 15: cannot trust what was felt, so it probes again",
            "12.9 mm right\n10.8° anticlockwise",
            "felt 12.9 mm right, 10.8° anticlockwise of the gap",
        ],
    )
    driver.gives_up()


def test_an_insertion_is_found_by_a_part_of_its_name(live: LiveService, page: Any) -> None:
    for name in ("20260928-part-4711", "20260928-part-4712"):
        insertion(live, name).gives_up()
    page.goto(live.url("/#history"))
    wait_until(page, "document.querySelectorAll('#past tr').length >= 2")
    page.get_by_label("Insertion", exact=True).fill("4711")
    wait_until(page, "document.querySelectorAll('#past tr').length === 1")
    assert page.locator("#past button").get_attribute("aria-label") == "play back 20260928-part-4711"
