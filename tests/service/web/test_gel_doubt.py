"""Who watches is told which camera does not show its gel: swapped cameras are found before anything is gripped."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from websockets.sync.client import connect

from service.contract import FINGERS, wire
from service.session.station import Station
from service.web.routes.cameras import examined
from tests.service.conftest import LiveService

PIXELS = {finger: np.full((4, 4, 3), grey, np.uint8) for finger, grey in zip(FINGERS, (10, 20), strict=True)}
NEWEST = {finger: SimpleNamespace(frame=SimpleNamespace(pixels=PIXELS[finger])) for finger in FINGERS}


def says(own: str, beside: str, pixels: Any) -> str:
    return f"{own} beside {beside} shows {pixels.max()}"


def station(**changes: Any) -> Station:
    plain: dict[str, Any] = {
        "manager": SimpleNamespace(calibration=SimpleNamespace(camera=str)),
        "cameras": {finger: SimpleNamespace(latest=NEWEST[finger]) for finger in FINGERS},
        "active": None,
        "camera_entries": lambda: tuple(wire.CameraEntry(finger=f, source="x", state="live", gel=f) for f in FINGERS),
    }
    return cast("Station", SimpleNamespace(**plain | changes))


def doubts(of: Station) -> list[str]:
    return [entry.gel_doubt for entry in examined(of)]


def test_each_camera_is_compared_with_its_own_calibration_and_the_other_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.web.routes.cameras.doubt", says)
    assert doubts(station()) == ["left beside right shows 10", "right beside left shows 20"]
    assert [entry.gel for entry in examined(station())] == list(FINGERS)


@pytest.mark.parametrize(
    "changes",
    [
        {"manager": SimpleNamespace(calibration=None)},
        {"active": "an insertion"},
        {"cameras": {finger: SimpleNamespace(latest=None) for finger in FINGERS}},
    ],
)
def test_nothing_is_said_of_a_gel_that_is_not_known_not_open_or_not_seen(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.web.routes.cameras.doubt", says)
    assert doubts(station(**changes)) == ["", ""]


def test_a_watcher_is_doubted_and_a_driver_is_not(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.web.routes.cameras.doubt", lambda *_: "another gel")
    doubted = {}
    for role in ("watch", "drive"):
        with connect(live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None) as link:
            link.send(wire.ClientHello(insertion_id=f"gel-{role}", client="test", role=role).model_dump_json())
            hello = wire.parse_service(link.recv(20))
            assert isinstance(hello, wire.ServiceHello)
            doubted[role] = {camera.gel_doubt for camera in hello.cameras}
            if role == "drive":
                link.send(wire.Abort(insertion_id="gel-drive", cause="operator", reason="done").model_dump_json())
                assert wire.parse_service(link.recv(20)).type == "finished"
    assert doubted == {"watch": {"another gel"}, "drive": {""}}
