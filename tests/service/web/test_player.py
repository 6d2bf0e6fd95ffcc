"""The playback in a real Chromium: what belongs to one recording never shows up in another."""

import json
from typing import Any

import pytest

from tests.service.conftest import LiveService
from tests.service.web import test_dashboard
from tests.service.web.test_dashboard import colours, insertion, wait_until
from tests.service.web.test_regrasps import put_back

browser, page, pytestmark = test_dashboard.browser, test_dashboard.page, test_dashboard.pytestmark
PLAYED = "document.querySelectorAll('#curves canvas').length === 3"


@pytest.fixture
def moments(page: Any) -> list[str]:
    """The addresses of all moments that the page asks for."""
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if "/moments/" in request.url else None)
    return asked


def test_an_answer_that_comes_late_is_not_shown_in_the_recording_opened_since(
    live: LiveService, page: Any, moments: list[str]
) -> None:
    for name in ("late", "prompt"):
        insertion(live, name).after(1).gives_up()
    held: list[Any] = []
    page.route("**/*_late/timeline?*", lambda route: held.append(route))  # noqa: PLW0108 - a method of a list takes no mark
    page.goto(live.url("/#history"))
    page.get_by_label("play back late", exact=True).click()
    while not held:
        page.wait_for_timeout(30)
    page.locator("#close").click()
    page.get_by_label("play back prompt", exact=True).click()
    wait_until(page, PLAYED)
    wait_until(page, "document.getElementById('right-then-state').textContent !== ''")
    held[0].continue_()
    page.wait_for_timeout(1000)
    page.locator("#scrub").focus()
    page.keyboard.press("End")
    wait_until(page, "!document.getElementById('then').textContent.startsWith('0.00 s')")
    page.wait_for_timeout(500)
    assert page.evaluate(PLAYED)
    assert {url.split("/moments/")[0].rpartition("_")[2] for url in moments} == {"prompt"}
    assert page.problems == []


def test_both_fingers_are_played_although_answers_are_slow(live: LiveService, page: Any, moments: list[str]) -> None:
    """As during an insertion, which goes first: the right finger would stand still beside a left one that moves."""
    insertion(live, "slow").after(1).gives_up()
    page.goto(live.url("/#history"))
    page.get_by_label("play back slow", exact=True).click()
    wait_until(page, "document.getElementById('right-then-state').textContent !== ''")
    page.route("**/moments/**", lambda route: (page.wait_for_timeout(150), route.continue_()))
    moments.clear()
    page.locator("#play").click()
    page.wait_for_timeout(1500)
    page.locator("#play").click()
    page.wait_for_timeout(1000)
    left_n, right_n = (sum(f"/{finger}/" in url for url in moments) for finger in ("left", "right"))
    assert left_n == right_n >= 2
    assert page.problems == []


def test_a_recording_without_frames_shows_none_of_the_one_before(live: LiveService, page: Any) -> None:
    for name, attempts_n in (("framed", 1), ("frameless", 0)):
        insertion(live, name).after(attempts_n).gives_up()
    page.goto(live.url("/#history"))
    page.get_by_label("play back framed", exact=True).click()
    wait_until(page, "document.getElementById('right-then-state').textContent !== ''")
    page.locator("#close").click()
    page.get_by_label("play back frameless", exact=True).click()
    wait_until(page, "document.getElementById('then').textContent.includes('No frame')")
    for finger in ("left", "right"):
        assert page.locator(f"#{finger}-then-state").text_content() == ""
        assert colours(page, f"{finger}-then") == 1, "an empty drawing"


@pytest.mark.parametrize("gone", ["left", "right"])
def test_a_finger_without_a_picture_at_a_moment_is_grey_and_named(live: LiveService, page: Any, gone: str) -> None:
    insertion(live, f"no-{gone}").after(1).gives_up()

    def answer(route: Any) -> None:
        curves = route.fetch().json()
        curves["moments"][-1][gone] = None
        route.fulfill(json=curves)

    page.route("**/timeline?*", answer)
    page.goto(live.url("/#history"))
    page.get_by_label(f"play back no-{gone}", exact=True).click()
    state = f"document.getElementById('{gone}-then-state').textContent"
    grey = f"document.getElementById('{gone}-then').classList.contains('stale')"
    for key, lost in (("Home", False), ("End", True), ("Home", False)):
        page.locator("#scrub").focus()
        page.keyboard.press(key)
        wait_until(page, f"{state} !== '' && ({state} === 'no picture') === {json.dumps(lost)}")
        assert page.evaluate(grey) is lost
        assert page.locator("canvas.stale:visible").count() == lost, "the other one is of that moment"
    page.keyboard.press("End")
    wait_until(page, grey)
    page.locator("#close").click()
    page.unroute("**/timeline?*")
    page.get_by_label(f"play back no-{gone}", exact=True).click()
    wait_until(page, f"{state} !== '' && !{grey}")
    assert page.problems == []


def test_the_playback_of_an_object_that_was_put_back_counts_as_its_title_does(live: LiveService, page: Any) -> None:
    put_back(live, "before", "refused")
    again = insertion(live, "after", continues="before")
    again.insert(1)
    again.close()
    page.goto(live.url("/#history"))
    page.get_by_label("play back after", exact=True).click()
    wait_until(page, PLAYED)
    assert page.locator("#player-title").text_content().endswith("inserted, after 2 attempts")
    page.locator("#scrub").focus()
    page.keyboard.press("End")
    wait_until(page, "document.getElementById('then').textContent.endsWith('object inserted after 2 attempts')")
    assert page.problems == []


@pytest.mark.parametrize("attempts_n", [0, 1])
def test_a_playback_ends_with_how_and_why_the_insertion_ended(live: LiveService, page: Any, attempts_n: int) -> None:
    """Its end comes after the last frame that was judged, or there was no frame at all."""
    driver = insertion(live, f"stopped-after-{attempts_n}").after(attempts_n)
    driver.gives_up("arm", "arm: controller: motors off")
    page.goto(live.url("/#history"))
    page.get_by_label(f"play back {driver.id}", exact=True).click()
    wait_until(page, PLAYED)
    page.locator("#scrub").focus()
    page.keyboard.press("End")
    wait_until(page, "document.getElementById('then').textContent.includes('; arm: controller: motors off; holding:')")
    assert page.problems == []


def test_what_ended_as_it_was_meant_to_is_listed_and_counts_neither_as_tried_nor_in_the_trend(
    live: LiveService, page: Any
) -> None:
    for name in ("ended once", "ended twice"):
        insertion(live, name.replace(" ", "-")).gives_up()
    insertion(live, "probe").gives_up("probed", "a probe, done")
    insertion(live, "turned").gives_up("afresh", "turned")
    insertion(live, "failed").gives_up("arm", "arm: controller: motors off")
    page.goto(live.url("/#history"))
    counted = "/of [0-9]+ inserted.*; [0-9]+ aborted, [0-9]+ probed, [0-9]+ regrasped, not counted$/"
    wait_until(page, f"{counted}.test(document.getElementById('count').textContent)")
    for outcome in ("probed", "regrasped"):
        page.get_by_label("Outcome").select_option(outcome)
        wait_until(page, f"/^[0-9]+ {outcome}$/.test(document.getElementById('count').textContent)")
        how = page.locator("#past tr:first-child td:nth-child(3)")
        assert (how.text_content(), how.get_attribute("class")) == (outcome, ""), "in no colour of a failure"
    page.get_by_label("Outcome").select_option("aborted")
    wait_until(page, "/^[0-9]+ aborted$/.test(document.getElementById('count').textContent)")
    wait_until(page, "document.getElementById('trend').textContent.includes('needs two insertions')")
    assert page.locator("#past tr").count() >= 2
    assert page.problems == []
