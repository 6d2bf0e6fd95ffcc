"""The door is locked from the start: who may call, by which name, from which page. On real sockets."""

import json
import re
import shutil
import socket
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.contract import wire
from service.settings import Settings
from tests.service.client import greeted
from tests.service.conftest import LiveService, live_service, served
from tests.service.tiny_models import write_models
from tests.waiting import wait_for

DRIVE, ADMIN = "a-token-for-driving", "a-token-for-administration"
REBOUND = "evil.example"  # a page's name, made to resolve to this machine


def test_a_name_that_is_not_ours_is_refused_on_every_door(live: LiveService) -> None:
    """DNS rebinding: the browser believes that our port is the page's own origin."""
    for path in ("/", "/v1/models", "/v2", "/metrics", "/healthz", "/dashboard/main.js"):
        named = {"Host": f"{REBOUND}:{live.port}", "Origin": f"http://{REBOUND}:{live.port}"} | live.bearer
        assert httpx.get(live.url(path), headers=named).status_code == 400
    delete = httpx.delete(live.url("/v1/recordings/x"), headers=live.bearer | {"Host": REBOUND})
    assert delete.status_code == 400
    for path in ("/v1/insertion", "/v1/live", "/v1/cameras/left/push"):
        link = socket.create_connection(("127.0.0.1", live.port), 20)
        with pytest.raises(InvalidStatus, match="400"):
            connect(f"ws://{REBOUND}:{live.port}{path}", sock=link, additional_headers=live.bearer)
        link.close()
    for name in ("localhost", "127.0.0.1", "[::1]"):
        assert httpx.get(live.url("/v1/models"), headers={"Host": f"{name}:{live.port}"}).status_code == 200


def test_a_machine_may_be_given_more_names(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder, allowed_hosts=("cell-pc.example", "*.plant.example")) as named:
        for name, code in (("cell-pc.example", 200), ("a.plant.example", 200), ("plant.example.evil", 400)):
            assert httpx.get(named.url("/healthz"), headers={"Host": name}).status_code == code


def test_without_the_token_this_machine_may_watch_and_nothing_else(live: LiveService) -> None:
    watching = ("/", "/v1/models", "/v1/cameras", "/v1/recordings", "/v1/versions", "/v2", "/readyz", "/metrics")
    assert {httpx.get(live.url(path)).status_code for path in watching} == {200}
    for method, path in (
        ("POST", "/v1/decisions"),
        ("POST", "/v2/models/direction.step/infer"),
        ("DELETE", "/v1/recordings/x"),
        ("DELETE", "/v1/versions/shadow"),
        *(("POST", f"/v1/versions/{change}?folder=x") for change in ("shadow", "promote", "rollback")),
    ):
        refused = httpx.request(method, live.url(path))
        assert refused.status_code == 401
        assert "names the token's file at its start" in refused.json()["error"]
    with pytest.raises(InvalidStatus, match="403"):
        connect(live.url("/v1/cameras/left/push", "ws"))
    with connect(live.url("/v1/insertion", "ws")) as link:
        link.send(wire.ClientHello(insertion_id="nobody", client="test").model_dump_json())
        refused = wire.parse_service(link.recv(20))
        assert (refused.code, refused.fatal) == ("forbidden", True)
    assert live.station.active is None
    wrong = httpx.get(live.url("/v1/models"), headers={"Authorization": "Bearer wrong"})
    assert (wrong.status_code, "this token is unknown" in wrong.json()["error"]) == (401, True)


def test_a_token_of_ones_own_takes_the_generated_ones_place(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder, token_drive=DRIVE, token_admin=ADMIN) as own:
        assert not (tmp_path / "state").exists()
        shadow = write_models(tmp_path / "shadow", git_commit="1" * 40)
        path = own.url(f"/v1/versions/shadow?folder={shadow}")
        codes = [httpx.post(path, headers={"Authorization": f"Bearer {t}"}).status_code for t in (DRIVE, ADMIN)]
        assert codes == [403, 200]


def test_a_page_may_not_be_framed_and_runs_only_what_is_ours(live: LiveService) -> None:
    for path in ("/", "/dashboard/main.js", "/v1/models", "/nowhere", "/openapi.json"):
        headers = httpx.get(live.url(path)).headers
        policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
        assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
        assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
        assert headers["x-frame-options"] == "DENY"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["referrer-policy"] == "no-referrer"


def test_the_page_needs_nothing_that_the_policy_forbids(live: LiveService) -> None:
    """tests/service/web/test_dashboard.py asks a real browser; this asks the text, where no browser is installed."""
    page = httpx.get(live.url("/")).text
    assert not re.search(r"<script(?![^>]*\bsrc=)|\son\w+=|\sstyle=|<style|javascript:", page)
    sources = re.findall(r"(?:src|href)=\"([^\"]+)\"", page)
    assert sources
    assert all(source.startswith(("/", "#")) for source in sources)
    assert httpx.get(live.url("/v1/docs")).status_code == 404  # its scripts would come from elsewhere


def test_a_foreign_page_cannot_embed_what_the_cameras_show(live: LiveService) -> None:
    embedded = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}
    assert httpx.get(live.url("/v1/cameras/left/stream.mjpg"), headers=embedded).status_code == 403
    ours = embedded | {"Sec-Fetch-Site": "same-origin"}
    assert httpx.get(live.url("/v1/cameras"), headers=ours).status_code == 200
    followed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert httpx.get(live.url("/v1/recordings"), headers=followed).status_code == 200


def test_no_link_in_a_recording_leads_to_another_file(live: LiveService) -> None:
    """As from somebody's archive, unpacked there to be looked at: the token would be anybody's who may watch."""
    whole = {"insertion_id": "linked", "outcome": "inserted", "attempts": 1}
    outside = live.recordings.parent / "elsewhere"
    folders = live.recordings / "20260101T000000_file", live.recordings / "20260101T000001_folder"
    for folder, at in ((folders[0], folders[0]), (folders[1], outside)):
        at.mkdir()
        (at / "summary.json").write_text(json.dumps(whole))
        (at / "insertion.mcap").symlink_to(live.recordings.parent / "state" / "token")
        if at is not folder:
            folder.symlink_to(at)
    for folder in folders:
        for method, path in (("GET", ""), ("GET", "/timeline"), ("GET", "/moments/left/1"), ("POST", "/decide")):
            answer = httpx.request(method, live.url(f"/v1/recordings/{folder.name}{path}"))
            assert (answer.status_code, live.token in answer.text) == (404, False)
    folders[1].unlink()
    shutil.rmtree(folders[0])


def test_a_cameras_password_is_shown_to_nobody(tmp_path: Path, models_folder: Path) -> None:
    """/readyz is open to everybody, /v1/cameras to whoever may watch, and a recording holds the settings."""
    secret = "hunter2"
    cameras = {
        "camera_left": f"http://127.0.0.1:9/v?user=a&pwd={secret}",
        "camera_right": f"http://a:{secret}@[::1]:9/v",
    }
    settings = Settings(models=models_folder, recordings=tmp_path / "r", state=tmp_path / "state", **cameras)
    with served(settings) as (station, port):
        wait_for(lambda: {camera.state for camera in station.cameras.values()} == {"lost"})
        paths = ("/readyz", "/v1/cameras", "/v1/status", "/metrics")
        texts = [httpx.get(f"http://127.0.0.1:{port}{path}").text for path in paths]
    assert not any(secret in text for text in [*texts, settings.model_dump_json()])
    assert all(url in texts[0] for url in ("http://127.0.0.1:9/v?...: ", "http://[::1]:9/v: "))


def test_no_header_makes_another_client_of_a_peer(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder, requests_per_s=0.5) as slow:

        def ask(number: int) -> int:
            address = f"203.0.113.{number}"
            headers = {
                "Authorization": f"Bearer {number}",
                "X-Forwarded-For": address,
                "Forwarded": f"for={address}",
                "X-Real-IP": address,
            }
            return httpx.get(slow.url("/v1/models"), headers=headers).status_code

        assert [ask(number) for number in range(20)].count(429) >= 15
        assert httpx.get(slow.url("/healthz")).status_code == 200
        driver = greeted(slow, "still-gets-in")
        assert driver.insert(1).outcome == "inserted"
        driver.close()
