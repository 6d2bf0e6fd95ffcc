"""The page in a real Chromium where the service does not let it in, or does not answer: it says why, and what to do."""

import re
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

from simulation.studies.motion_bounds.relay import Relay
from tests.service.conftest import LiveService, live_service
from tests.service.web import test_dashboard
from tests.service.web.test_dashboard import insertion, says, wait_until

browser, page, pytestmark = test_dashboard.browser, test_dashboard.page, test_dashboard.pytestmark
DATED = r"/ of [0-9]+ [A-Z][a-z]+, [0-9:]{8}\. /.test(document.getElementById('detail').textContent)"
TOKEN = "sixteen-or-more-characters"


def test_an_address_without_the_token_or_with_a_wrong_one_is_named(
    browser: Any, tmp_path: Path, models_folder: Path
) -> None:
    with live_service(tmp_path, models_folder, token_watch=SecretStr(TOKEN)) as live:
        page = browser.new_page()
        for address in ("/", "/?token=another-one-of-them"):
            page.goto(live.url(address))
            says(page, "lacks the token, or has a wrong one")
            assert "?token=" in page.locator("#detail").text_content()
        page.goto(live.url(f"/?token={TOKEN}"))
        wait_until(page, "document.getElementById('headline').className === 'good'")
        page.close()


def test_a_page_too_many_says_so_and_connects_by_itself(
    browser: Any, tmp_path: Path, models_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.web.routes.live.MAX_PAGES", 1)
    with live_service(tmp_path, models_folder) as live:
        first, second = browser.new_page(), browser.new_page()
        first.goto(live.url("/"))
        wait_until(first, "document.getElementById('headline').className === 'good'")
        second.goto(live.url("/"))
        says(second, "Too many pages are open")
        first.close()
        wait_until(second, "document.getElementById('headline').className === 'good'")
        second.close()


def test_a_playback_says_when_the_service_does_not_answer(live: LiveService, page: Any) -> None:
    for name in ("open", "later"):
        insertion(live, name).after(1).gives_up()
    page.goto(live.url("/#history"))
    page.get_by_label("play back open", exact=True).click()
    wait_until(page, "document.getElementById('then').textContent.includes(' s ')")
    page.route("**/v1/recordings/**", lambda route: route.abort())
    page.locator("#again").click()
    wait_until(page, "document.getElementById('answer').textContent.includes('does not answer')")
    page.locator("#play").click()
    wait_until(page, "document.getElementById('then').textContent.includes('does not answer')")
    wait_until(page, "document.getElementById('play').textContent === 'Play'")
    page.locator("#close").click()
    page.get_by_label("play back later", exact=True).click()
    wait_until(page, "document.getElementById('then').textContent.includes('does not answer')")


def test_a_history_that_cannot_be_read_says_so(live: LiveService, page: Any) -> None:
    page.route("**/v1/recordings?*", lambda route: route.abort())
    page.goto(live.url("/#history"))
    wait_until(page, "document.getElementById('count').textContent.includes('does not answer')")
    page.unroute("**/v1/recordings?*")
    page.goto(live.url("/#live"))
    page.goto(live.url("/#history"))
    wait_until(page, "!document.getElementById('count').textContent.includes('does not answer')")


def test_what_is_old_says_of_when_and_on_another_day_of_which(live: LiveService, browser: Any) -> None:
    """Also on a laptop that slept: its steady clock stood still meanwhile, and the clock on its wall did not."""
    with closing(Relay.to(live.url(""))) as relay, closing(browser.new_page()) as page:
        page.clock.install()
        page.goto(f"{relay.url}/")
        wait_until(page, "document.querySelectorAll('#health .good').length >= 2")
        relay.misbehave("half open")
        says(page, "no connection to the service")
        assert re.match(r"What is shown below is of \d\d:\d\d:\d\d\. ", page.locator("#detail").text_content())
        assert page.evaluate("getComputedStyle(document.getElementById('left')).opacity") < "1", "drawings are greyed"
        page.clock.set_system_time(time.time() + 86_400)
        wait_until(page, DATED)
        relay.misbehave("fair")
        wait_until(page, "getComputedStyle(document.getElementById('left')).opacity === '1'")
