"""The history and the drawings in a real Chromium: on a phone, with a thousand insertions, in another time zone."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from tests.service.conftest import LiveService
from tests.service.web import test_dashboard
from tests.service.web.test_dashboard import PANELS, insertion, says, wait_until

browser, page, pytestmark = test_dashboard.browser, test_dashboard.page, test_dashboard.pytestmark
LONG = "box_of_500_mg_paracetamol_twenty_tablets_in_blisters_new_folding_carton_Germany"
TREND = "document.querySelectorAll('#trend canvas').length === 3"


def listed(count: int) -> dict[str, Any]:
    """What the service answers for so many insertions, newest first, all on one day."""
    how = {"outcome": "inserted", "cause": None, "attempts": 2, "descended_n": 2, "continues": None, "seconds": 9.1}
    how |= {"started": "2026-07-01 22:30:00", "intervals_held_n": 4, "intervals_n": 4, "decisions": [], "doubts": []}
    names = [f"20260701T223000_part-{number:04d}" for number in range(count, 0, -1)]
    rows = [how | {"name": name, "insertion_id": name.partition("_")[2], "object": LONG} for name in names]
    return {"recordings": rows, "problems": []}


@contextmanager
def history(live: LiveService, browser: Any, count: int, panel: str, **options: Any) -> Iterator[Any]:
    width, height = PANELS[panel]
    page = browser.new_page(viewport={"width": width, "height": height}, **options)

    def answer(route: Any) -> None:
        asked = int(parse_qs(urlsplit(route.request.url).query)["newest"][0])
        route.fulfill(json=listed(min(count, asked)))

    page.route("**/v1/recordings?*", answer)
    page.goto(live.url("/#history"))
    wait_until(page, "document.querySelectorAll('#past tr').length > 0")
    yield page
    page.close()


@pytest.mark.parametrize("panel", ["phone", "small panel", "panel"])
def test_a_thousand_insertions_fit(live: LiveService, browser: Any, panel: str) -> None:
    """Charts as high as the list, and names as wide as the longest one, would leave nothing to look at."""
    with history(live, browser, 1000, panel) as page:
        wait_until(page, TREND)
        count = page.locator("#count").text_content()
        assert count == "500 of 500 inserted, 2.00 attempts on average; the newest 500 listed"
        assert page.locator("#past tr").count() == 500
        wide = "e => e.offsetParent && e.scrollWidth > e.clientWidth"
        sideways = f"[document.documentElement, ...document.querySelectorAll('.table, .filters')].filter({wide}).length"
        assert page.evaluate(sideways) == 0
        heights = page.evaluate("[...document.querySelectorAll('#trend canvas')].map(c => c.clientHeight)")
        assert min(heights) > 80
        assert sum(heights) < PANELS[panel][1]


def test_trends_that_are_shown_no_more_are_let_go(live: LiveService, browser: Any) -> None:
    """A page stays open for months, and each insertion and each letter of a filter draws the trends anew."""
    with history(live, browser, 40, "panel") as page:
        wait_until(page, TREND)
        for part in ("part-000", "part-00", "part"):
            page.get_by_label("Insertion", exact=True).fill(part)
            wait_until(page, TREND)
        assert page.evaluate("uPlot.sync('trend').plots.length") == 3


def test_the_history_has_the_clock_of_the_alarms(live: LiveService, browser: Any) -> None:
    """A person compares the two, and the clock on the wall."""
    with history(live, browser, 1, "panel", timezone_id="Europe/Berlin") as page:
        assert page.locator("#past td").first.text_content() == "2 Jul 00:30"


def test_on_a_phone_what_is_wrong_comes_before_what_goes_on(live: LiveService, browser: Any) -> None:
    insertion(live, "wrong").gives_up("part_lost", "width 3.1 mm")
    width, height = PANELS["phone"]
    page = browser.new_page(viewport={"width": width, "height": height})
    page.goto(live.url("/"))
    says(page, "Holding")
    alarms, following = (page.locator(f"#live .{part}").bounding_box()["y"] for part in ("alarms", "next"))
    assert alarms < following
    page.close()


def test_an_object_at_the_edge_of_the_range_is_drawn_whole(page: Any) -> None:
    drawn = page.evaluate(
        """async () => { const { drawSide } = await import("/dashboard/place.js");
          const svg = document.getElementById("side");
          drawSide(svg, { gap_width_mm: 56, expected_depth_mm: 25, depth_mm: 3, pose: [15, 0] });
          const { x, width } = svg.viewBox.baseVal, box = svg.querySelector(".object").getBBox();
          return [box.x - x, x + width - box.x - box.width]; }"""
    )
    assert min(drawn) >= 0
