"""Pictures of a commissioning: what the fingers saw, beside the record and covered by it."""

import asyncio
import hashlib
import re
import xml.etree.ElementTree as ET
from base64 import b64decode

import cv2
import numpy as np
import pytest

from robot_client.ports import DriverError
from robot_client.session.commission import pictures
from robot_client.session.commission.pictures import picture_of, svg
from robot_client.session.commission.record import RECORD, read_record
from robot_client.session.commission.run import PRESSES
from robot_client.session.service_link import ServiceSettings
from service.contract.frames import ContractError
from service.contract.token import TOKEN_FILE
from tests.robot_client.session.test_commission import Cell, commissioning
from tests.service.client import greeted
from tests.service.conftest import LiveService, live

__all__ = ["live"]


def pictured(path, cell, picture, record=None):
    running = commissioning(cell, path, record)
    running.press, running.grips_n = lambda _grip_n, *place: cell.probe(*place), (None,)
    running.picture = picture
    return asyncio.run(running.run(8))


def settings_of(live):
    return ServiceSettings(url=live.url("/v1/insertion", "ws"), token_file=live.station.settings.state / TOKEN_FILE)


async def drawn(_insertion_id, caption):
    return f"<svg>{caption}</svg>"


def test_a_picture_of_each_sign_and_press_lies_beside_the_record(tmp_path):
    record = pictured(tmp_path / RECORD, Cell(), drawn)
    names = [*(f"sign_{n}.svg" for n in range(1, 5)), *(f"press_{n + 1}.svg" for n in range(len(PRESSES)))]
    assert list(record.pictures) == names
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([RECORD, *names])
    first = (tmp_path / "sign_1.svg").read_bytes()
    assert record.pictures["sign_1.svg"] == hashlib.sha256(first).hexdigest()
    assert b"sign_1: +8.0 mm, +8.0 deg" in first


@pytest.mark.parametrize("change", [lambda path: path.write_text("<svg/>"), lambda path: path.unlink()])
@pytest.mark.parametrize("name", ["sign_3.svg", "press_2.svg"])
def test_a_picture_that_was_changed_or_removed_invalidates_the_record(tmp_path, name, change):
    pictured(tmp_path / RECORD, Cell(), drawn)
    change(tmp_path / name)
    with pytest.raises(ContractError, match=f"{name} is not as it was written: move its folder away"):
        read_record(tmp_path / RECORD)


def test_a_probe_without_its_picture_is_not_kept_and_made_again(tmp_path):
    """A service that cannot show it holds the cell: the next run begins with this probe."""
    path, cell, asked = tmp_path / RECORD, Cell(), []

    async def fails_once(insertion_id, caption):
        asked.append(caption)
        if len(asked) == 6:
            raise DriverError("service: no picture")
        return await drawn(insertion_id, caption)

    with pytest.raises(DriverError, match="no picture"):
        pictured(path, cell, fails_once)
    record = read_record(path)
    assert (len(record.signs), len(record.presses), len(record.pictures)) == (4, 1, 5)
    record = pictured(path, cell, fails_once, record)
    assert (len(record.presses), len(record.pictures), record.done_n) == (2, 6, 8)
    assert cell.probed[5] == cell.probed[6]


def test_the_service_shows_both_gels_open_and_pressed_over_a_real_socket(live: LiveService):
    driver = greeted(live, "pictured")
    driver.attempt(1)
    driver.gives_up("probed", "probed")
    root = ET.fromstring(asyncio.run(picture_of(settings_of(live), "pictured", "sign_1: <+8 mm>")))
    space = "{http://www.w3.org/2000/svg}"
    texts = [text.text for text in root.iter(f"{space}text")]
    assert texts[0].startswith("sign_1: <+8 mm>")
    assert texts[1:] == ["left, open", "left, pressed", "right, open", "right, pressed"]
    jpegs = [b64decode(image.get("href").partition(",")[2]) for image in root.iter(f"{space}image")]
    shapes = [cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape for jpeg in jpegs]
    assert shapes == [(320, 327)] * 4
    arrows = [[path.get("d") for path in panel.iter(f"{space}path")] for panel in root.iter(f"{space}g")]
    assert [bool(panel) for panel in arrows] == [False, True, False, True]
    assert any("h4v4" in arrow for arrow in arrows[1]), "which of them slip"
    far = max(abs(float(re.search(r" (-?[0-9.]+)$", arrow)[1])) for arrow in arrows[1] + arrows[3])
    assert far > 4.0, "the gel was pressed up by more than a pixel"


@pytest.mark.parametrize(
    ("gone", "why"),
    [
        (slice(-1, None), ""),
        (slice(1, None), "one finger had none at its end"),
        (slice(None), "at no moment had both fingers one"),
    ],
    ids=["last", "all but the first", "all"],
)
def test_of_a_finger_that_has_no_picture_at_the_last_moment_none_is_asked_for(
    live: LiveService, monkeypatch, gone, why
):
    """A late camera's last ones may be missing; one that failed before the press shows no press."""
    driver = greeted(live, f"one-eyed-{gone.start}")
    driver.attempt(1)
    driver.gives_up("probed", "probed")
    got = pictures._got

    async def without_right(http, path, **asked):
        content = await got(http, path, **asked)
        for moment in content["moments"][gone] if path.endswith("timeline") else ():
            moment["right"] = None
        return content

    monkeypatch.setattr(pictures, "_got", without_right)
    asked = picture_of(settings_of(live), driver.id, "")
    if why:
        with pytest.raises(DriverError, match=f"no picture of {driver.id}: {why}"):
            asyncio.run(asked)
    else:
        assert "right, pressed" in asyncio.run(asked)


def test_an_arrow_is_as_long_as_the_motion_and_one_that_slips_has_a_square():
    content = {"width": 40, "height": 30, "jpeg": "", "rest": [5, 6, 7, 8, 9, 9], "moved": [1, -2, 0.5, 0, 1, 1]}
    text = svg("x", [("left", {**content, "kinds": [1, 2, -1]})])
    assert re.findall(r' d="([^"]*)"', text) == ["M5.0 6.0l4.0 -8.0", "M7.0 8.0m-2 -2h4v4h-4zm2 2l2.0 0.0"]


NOTHING = r"nothing of it was recorded within 0.3 s; GET /readyz of the service says why"


@pytest.mark.parametrize(("insertion_id", "why"), [("nowhere", NOTHING), ("../x", "HTTPStatusError")])
def test_a_recording_that_is_not_there_is_named(live: LiveService, monkeypatch, insertion_id, why):
    monkeypatch.setattr(pictures, "WAIT_S", 0.3)
    with pytest.raises(DriverError, match=f"service: no picture of {insertion_id}: {why}"):
        asyncio.run(picture_of(settings_of(live), insertion_id, ""))
