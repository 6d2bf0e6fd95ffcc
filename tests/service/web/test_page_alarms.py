"""The page's alarms in a real Chromium: what they say stays true, also of old ones and under a keyboard's focus."""

import json
import re
import time
from pathlib import Path
from typing import Any

import httpx

from service.web.page.alarms import FILE, Alarms
from tests.service.conftest import LiveService, live_service
from tests.service.web import test_dashboard
from tests.service.web.test_dashboard import insertion, says, wait_until

browser, page, pytestmark = test_dashboard.browser, test_dashboard.page, test_dashboard.pytestmark
FIRST = "document.querySelector('#alarms li').textContent.includes"
FOCUSED = "document.activeElement.ariaLabel"


def test_an_alarm_under_the_keyboards_focus_says_when_its_fault_is_gone(live: LiveService, page: Any) -> None:
    wait_until(page, "document.querySelectorAll('#health .good').length >= 2")
    live.fingers[0].connected = False
    says(page, "No picture from the left camera")
    wait_until(page, f"{FIRST}('still there')")
    page.get_by_role("button", name=re.compile("acknowledge: Left camera")).focus()
    live.fingers[0].connected = True
    wait_until(page, f"{FIRST}('gone, not acknowledged')")
    assert page.evaluate(FOCUSED).startswith("acknowledge: Left camera"), "the focus stays where it was"
    page.keyboard.press("Enter")
    wait_until(page, "document.getElementById('open-alarms').textContent === ''")
    assert page.evaluate("document.activeElement.id") == "alarms", "there is nothing left to press"
    assert page.problems == []


def test_a_double_press_acknowledges_one_alarm(live: LiveService, page: Any) -> None:
    """Under the second press stands the next alarm, which nobody has read yet."""
    insertion(live, "lost").gives_up("part_lost", "width 3.1 mm")
    insertion(live, "broken").gives_up("arm", "arm: controller: motors off")
    page.clock.install()
    page.reload()
    says(page, "Holding: a fault of the arm")
    page.clock.pause_at(time.time() + 1.0)
    button = page.get_by_role("button", name="Acknowledge", exact=True)
    button.click()
    says(page, "Holding: the object slipped out of the fingers")
    button.click()
    page.wait_for_timeout(1000)
    says(page, "Holding: the object slipped out of the fingers")
    page.clock.run_for(1000)
    button.click()
    says(page, "Ready for the next object")


def test_an_alarm_of_another_day_says_which(browser: Any, tmp_path: Path, models_folder: Path) -> None:
    (tmp_path / "recordings").mkdir()
    alarms = Alarms(tmp_path / "recordings" / FILE)
    alarms.sound("insertion old", "stop", "Holding: all attempts used")
    alarms.sound("insertion new", "stop", "Holding: a fault of the arm")
    Alarms(tmp_path / "recordings" / FILE)  # reads behind what is being written
    facts = json.loads((tmp_path / "recordings" / FILE).read_text())
    facts[1]["at_s"] -= 3 * 86_400
    (tmp_path / "recordings" / FILE).write_text(json.dumps(facts))
    with live_service(tmp_path, models_folder) as live:
        page = browser.new_page(timezone_id="UTC")
        page.clock.install(time=time.time() - 3 * 86_400)  # the viewer's clock is wrong by as much
        page.goto(live.url("/"))
        wait_until(page, "document.querySelectorAll('#alarms li').length === 2")
        new, old = page.locator("#alarms li").all_text_contents()
        page.close()
        now = time.gmtime(httpx.get(live.url("/v1/status")).json()["now_s"] - 3 * 86_400)
    assert f"{now.tm_mday} {time.strftime('%b', now)}, " in old
    assert re.search(r"arm\d\d:\d\d:\d\d, not acknowledged", new), "no date on those of today"


def test_dropped_frames_are_shown_for_a_minute_though_the_viewers_clock_is_set_back(
    live: LiveService, browser: Any
) -> None:
    page, dropped = browser.new_page(), "document.getElementById('health').textContent.includes('dropped')"
    page.clock.install()
    page.goto(live.url("/"))
    wait_until(page, "document.querySelectorAll('#health .good').length >= 2")
    assert not page.evaluate(dropped)
    live.station.counters.frames_dropped_n += 1
    wait_until(page, dropped)
    page.clock.set_system_time(time.time() - 3600)
    page.clock.fast_forward("01:01")
    wait_until(page, f"document.querySelectorAll('#health .good').length >= 2 && !{dropped}")
    page.close()
