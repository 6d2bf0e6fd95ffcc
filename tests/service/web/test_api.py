import json
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.contract import TactileFrame, encode_frame, wire
from service.perception.rectification import Rectifier
from service.session.factory import make_session
from tests.docs.commands import ROOT
from tests.service import drawn
from tests.service.client import Driver, greeted
from tests.service.conftest import LiveService, live_service
from tests.service.session.test_state_machine import hello, probe

WATCH, DRIVE, ADMIN = "a-token-for-watching", "a-token-for-driving", "a-token-for-administration"


def test_the_page_and_its_modules_are_served(live: LiveService) -> None:
    assert "Tactile insertion" in httpx.get(live.url("/")).text
    for name in ("main.js", "felt.js", "place.js", "history.js", "player.js", "uplot/uPlot.iife.min.js", "style.css"):
        assert httpx.get(live.url(f"/dashboard/{name}")).status_code == 200


def test_an_answer_does_not_wait_for_the_acknowledgement_of_its_head(live: LiveService) -> None:
    """The kernel would hold it back by 40 ms on every connection that is kept."""

    def fifth_s(client: httpx.Client) -> float:
        waited_s = []
        for _ in range(20):
            begun_s = time.monotonic()
            client.get("/healthz").raise_for_status()
            waited_s.append(time.monotonic() - begun_s)
        return sorted(waited_s[2:])[4]

    with httpx.Client(base_url=live.url("")) as client:
        assert any(fifth_s(client) < 0.035 for _ in range(20)), "and not only on a busy machine"


def test_a_recorded_insertion_is_listed_played_and_removed(live: LiveService) -> None:
    greeted(live, "listed").after(1).gives_up()
    (entry,) = [r for r in httpx.get(live.url("/v1/recordings")).json()["recordings"] if r["insertion_id"] == "listed"]
    base = live.url(f"/v1/recordings/{entry['name']}")
    assert (entry["attempts"], entry["outcome"]) == (1, "aborted")
    assert httpx.get(base).content[:5] == b"\x89MCAP"
    assert httpx.delete(base, headers=live.bearer).status_code == 200
    assert httpx.get(base).status_code == 404


def test_a_recording_is_found_by_the_name_of_its_insertion_alone(live: LiveService) -> None:
    for name, insertion_id in (("20260101T000000_part-1", "part-1"), ("20260101T000001_part-10", "part-10")):
        (live.recordings / name).mkdir()
        facts = {"insertion_id": insertion_id, "outcome": "inserted", "attempts": 1}
        (live.recordings / name / "summary.json").write_text(json.dumps(facts))
    listed = httpx.get(live.url("/v1/recordings"), params={"insertion_id": "part-1"}).json()
    assert ([one["name"] for one in listed["recordings"]], listed["problems"]) == (["20260101T000000_part-1"], [])
    assert httpx.get(live.url("/v1/recordings"), params={"insertion_id": "part-2"}).json()["recordings"] == []
    refused = httpx.get(live.url("/v1/recordings"), params={"insertion_id": "part/1"})
    assert (refused.status_code, "insertion_id" in refused.json()["error"]) == (422, True)


def test_as_many_of_the_newest_recordings_are_listed_as_are_asked_for(live: LiveService) -> None:
    names = [f"2026010{day}T000000_again" for day in (3, 2, 1)]
    for name in names:
        (live.recordings / name).mkdir()
        facts = {"insertion_id": "again", "outcome": "inserted", "attempts": 1}
        (live.recordings / name / "summary.json").write_text(json.dumps(facts))

    def ask(**params: Any) -> httpx.Response:
        return httpx.get(live.url("/v1/recordings"), params={"insertion_id": "again"} | params)

    for params, listed in (({}, names), ({"newest": 2}, names[:2]), ({"newest": 10_000}, names)):
        assert [one["name"] for one in ask(**params).json()["recordings"]] == listed
    assert len(httpx.get(live.url("/v1/recordings"), params={"newest": 1}).json()["recordings"]) == 1
    for newest in (0, -1, 10_001, "all"):
        refused = ask(newest=newest)
        assert (refused.status_code, "newest" in refused.json()["error"]) == (422, True)


def test_a_recording_that_two_remove_at_once_is_removed_and_nothing_breaks(live: LiveService) -> None:
    folder = live.recordings / "20260101T000000_twice"
    folder.mkdir()
    for number in range(2000):
        (folder / f"{number}").touch()
    (folder / "summary.json").write_text("{}")
    url = live.url(f"/v1/recordings/{folder.name}")
    with ThreadPoolExecutor(2) as both:
        answers = list(both.map(lambda _: httpx.delete(url, headers=live.bearer), range(2)))
    assert 200 in {answer.status_code for answer in answers} <= {200, 404, 409}
    assert all(answer.json() for answer in answers)


def sequence(first: int, last: int, period_ns: int = drawn.PERIOD_NS) -> bytes:
    """Encoded rectified frames of a probe that moves from frame 10 and slips from frame 16 on."""
    rectifiers = {finger: Rectifier(drawn.calibration().camera(finger)) for finger in ("left", "right")}
    return b"".join(
        encode_frame(TactileFrame(finger, i, i * period_ns, rectifiers[finger].apply(drawn.raw(finger, i, 10, 16))))
        for i in range(first, last)
        for finger in ("left", "right")
    )


def test_a_sequence_is_not_decided_in_an_insertion_that_began_while_it_was_read(live: LiveService) -> None:
    def slowly(whole: bytes) -> Iterator[bytes]:
        yield whole[:1000]
        drivers.append(Driver(live, "meanwhile"))
        drivers[0].until("hello")
        yield whole[1000:]

    drivers: list[Driver] = []
    answer = httpx.post(live.url("/v1/decisions"), content=slowly(sequence(2, 22)), headers=live.bearer, timeout=60)
    assert (answer.status_code, answer.json()["error"][:5]) == (409, "busy:")
    drivers[0].send(wire.Abort(insertion_id="meanwhile", cause="operator", reason="done"))
    drivers[0].until("finished")
    drivers[0].close()


def test_a_recorded_sequence_is_decided_over_http_as_an_insertion_decides_it(live: LiveService) -> None:
    def post(body: bytes, **params: float) -> httpx.Response:
        return httpx.post(live.url("/v1/decisions"), content=body, headers=live.bearer, params=params)

    answer = post(sequence(2, 22))
    assert answer.status_code == 200
    assert sum(answer.json()["class_probabilities"].values()) == pytest.approx(1)
    session = make_session(live.station.models, drawn.calibration())
    hello(session)
    correction = probe(session, 1, 0)[-1]
    assert answer.json()["estimate"]["dx_mm"] == pytest.approx(correction.estimate.dx_mm, abs=0.5)
    refusals = {
        "expected pairs of encoded frames": sequence(2, 5)[:-1],
        "do not rise": sequence(2, 5, 0),
        "frame pairs since motion began": sequence(2, 15),
    }
    for words, body in refusals.items():
        refused = post(body)
        assert refused.status_code == 400
        assert words in refused.json()["error"]
    misspelt = post(sequence(2, 22), gap_width=80.0)
    assert (misspelt.status_code, "query.gap_width: " in misspelt.json()["error"]) == (422, True)


def test_models_and_cameras_are_told(live: LiveService) -> None:
    roles = [m["card"]["role"] for m in httpx.get(live.url("/v1/models")).json()["models"]]
    assert roles == ["direction", "magnitude"]
    assert len(httpx.get(live.url("/v1/cameras")).json()["cameras"]) == 2
    assert "/v1/decisions" in httpx.get(live.url("/openapi.json")).json()["paths"]


def test_a_method_that_a_path_does_not_take_is_answered_by_those_it_takes(live: LiveService) -> None:
    paths = httpx.get(live.url("/openapi.json")).json()["paths"]
    assert len(paths) > 25
    for path, operations in paths.items():
        url = live.url(path.replace("{finger}", "left").replace("{number}", "1").replace("{index}", "0"))
        answer = httpx.request("PATCH", url, headers=live.bearer)
        assert answer.status_code == 405, path
        assert set(answer.headers["allow"].split(", ")) == {method.upper() for method in operations}, path
        assert answer.json() == {"error": "Method Not Allowed"}


def test_every_answer_in_json_has_a_schema_but_what_is_made_for_the_page(live: LiveService) -> None:
    described = httpx.get(live.url("/openapi.json")).json()
    answers = {
        (path, method): operation["responses"]
        for path, operations in described["paths"].items()
        for method, operation in operations.items()
    }
    assert [path for path, responses in answers.items() if "application/json" not in responses["4XX"]["content"]] == []
    assert [path for path, responses in answers.items() if not responses["200"].get("content")] == []
    open_ones = {
        path
        for (path, _), responses in answers.items()
        for content in responses["200"].get("content", {}).values()
        if path.startswith("/v1") and set(content["schema"]) <= {"type", "title", "additionalProperties"}
        if content["schema"].get("additionalProperties", True) is True and content["schema"].get("type") == "object"
    }
    pages_own = {"/v1/status", *(f"/v1/recordings/{{name}}/{what}" for what in ("timeline", "decide"))}
    assert not [name for name in described["components"]["schemas"] if "__" in name], "two classes of one name"
    assert open_ones == {"/v1/asyncapi.json", "/v1/recordings/{name}/moments/{finger}/{at_ns}", *pages_own}


def test_the_description_names_the_role_that_each_route_asks_for(live: LiveService) -> None:
    described = httpx.get(live.url("/openapi.json")).json()
    assert described["components"]["securitySchemes"]["token"].items() >= {"type": "http", "scheme": "bearer"}.items()
    roles = {
        f"{method} {path}": [role for one in operation.get("security", ()) for role in one["token"]]
        for path, operations in described["paths"].items()
        for method, operation in operations.items()
    }
    assert roles["get /healthz"] == roles["get /metrics"] == []
    assert roles["get /v1/status"] == ["watch"]
    assert roles["post /v1/decisions"] == ["drive"]
    assert roles["delete /v1/recordings/{name}"] == ["admin"]
    for name, role in roles.items():
        method, path = name.split()
        url = live.url(path.replace("{finger}", "left").replace("{number}", "1").replace("{at_ns}", "0"))
        code = httpx.request(method, url, headers={"Authorization": "Bearer wrong"}).status_code
        assert (code == 401) == bool(role), name


@pytest.mark.parametrize("origin", ["http://evil.example", "http://[", "null", ""])
def test_a_foreign_page_is_refused(live: LiveService, origin: str) -> None:
    assert httpx.get(live.url("/v1/models"), headers={"Origin": origin}).status_code == 403


def test_tokens_give_roles(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder, token_watch=WATCH, token_drive=DRIVE, token_admin=ADMIN) as guarded:

        def code(method: str, path: str, token: str | None) -> int:
            headers = {"Authorization": f"Bearer {token}"} if token else {}
            return httpx.request(method, guarded.url(path), headers=headers).status_code

        assert code("GET", "/healthz", None) == 200
        assert [code("GET", "/v1/models", token) for token in (None, "x", WATCH, DRIVE, ADMIN)] == [
            401,
            401,
            200,
            200,
            200,
        ]
        assert [code("POST", "/v1/decisions", token) for token in (WATCH, DRIVE)] == [403, 400]
        assert [code("DELETE", "/v1/recordings/none", token) for token in (DRIVE, ADMIN)] == [403, 404]
        infer = "/v2/models/direction.step/infer"
        assert [code("POST", infer, token) for token in (None, "x", WATCH, DRIVE)] == [401, 401, 403, 400]
        assert [code("POST", infer.replace("direction", "no"), token) for token in (WATCH, DRIVE)] == [403, 404]


def test_every_door_tells_the_version_of_the_package(live: LiveService) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    versions = [httpx.get(live.url(page)).json()["info"]["version"] for page in ("/openapi.json", "/v1/asyncapi.json")]
    assert [*versions, httpx.get(live.url("/v2")).json()["version"]] == 3 * [version]
