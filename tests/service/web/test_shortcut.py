"""Small inference requests that come whole are answered without a turn of the loop, and as they would be otherwise."""

import contextlib
import http.client
import json
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.contract import FrameSpec
from service.session.station import Station
from service.settings import Settings
from service.web.gate import Gate
from service.web.routes.oip import Served
from tests.service import tiny_models
from tests.service.conftest import served
from tests.service.web.test_oip import junk

pytest.importorskip("httptools")  # without it every request takes the usual way
SPEC = FrameSpec(height_px=8, width_px=9)
PATH = "/v2/models/direction.step/infer"
SHAPES = {"frame": [1, 2, *SPEC.shape], "reference": [1, 2, *SPEC.shape], "state": [1, 6]}
BATCH_N = 4
Answer = tuple[int, dict[str, str], bytes]


@contextlib.contextmanager
def small_service(folder: Path, **changes: object) -> Iterator[tuple[Station, str]]:
    models = tiny_models.write_models(folder / "models", frame=SPEC)
    facts = {"models": models, "recordings": folder / "r", "camera_left": "push:", "camera_right": "push:"}
    with served(Settings(**facts | changes)) as (station, port):
        yield station, f"127.0.0.1:{port}"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Station, str]]:
    with small_service(tmp_path_factory.mktemp("small")) as running:
        yield running


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow this machine is at this moment."""
    monkeypatch.setattr(Served, "is_quick", lambda *_: True)


@pytest.fixture
def usual(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the requests that took the usual way."""
    paths: list[str] = []
    called = Gate.__call__

    async def noted(gate: Gate, scope, receive, send) -> None:  # type: ignore[no-untyped-def]
        paths.append(scope.get("path", ""))
        await called(gate, scope, receive, send)

    monkeypatch.setattr(Gate, "__call__", noted)
    return paths


def arrays(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    kinds = {name: np.float32 if name == "state" else np.uint8 for name in SHAPES}
    return {name: rng.integers(0, 200, shape).astype(kinds[name]) for name, shape in SHAPES.items()}


def body(tensors: dict[str, np.ndarray]) -> tuple[bytes, dict[str, str]]:
    inputs = [
        {
            "name": name,
            "datatype": "FP32" if name == "state" else "UINT8",
            "shape": list(values.shape),
            "parameters": {"binary_data_size": values.nbytes},
        }
        for name, values in tensors.items()
    ]
    head = json.dumps({"inputs": inputs, "outputs": [{"name": "logits", "parameters": {"binary_data": True}}]}).encode()
    content = head + b"".join(values.tobytes() for values in tensors.values())
    return content, {"Inference-Header-Content-Length": str(len(head))}


def asked(place: str, content: bytes, headers: dict[str, str], pause: Callable[[], None] | None = None) -> Answer:
    """Send a request whole, or its body a pause after its head."""
    host, port = place.split(":")
    lines = {"Host": place, "Content-Length": str(len(content))} | headers
    head = f"POST {PATH} HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in lines.items()) + "\r\n"
    with socket.create_connection((host, int(port)), 30) as link:
        if pause:
            link.sendall(head.encode())
            pause()
            link.sendall(content)
        else:
            link.sendall(head.encode() + content)
        answer = http.client.HTTPResponse(link)
        answer.begin()
        told = {name.lower(): value for name, value in answer.getheaders() if name.lower() != "date"}
        return answer.status, told, answer.read()


def test_a_small_request_is_answered_at_once_and_counted(service: tuple[Station, str], usual: list[str]) -> None:
    station, place = service
    model = next(model for model in station.models.models if model.path.name == "direction.step.onnx")

    def successes() -> int:
        (stats,) = httpx.get(f"http://{place}/v2/models/direction.step/stats").json()["model_stats"]
        return int(stats["inference_stats"]["success"]["count"])

    before = successes()
    for seed in range(3):
        status, headers, content = asked(place, *body(arrays(seed)))
        split = int(headers["inference-header-content-length"])
        wanted = model.run(arrays(seed))["logits"]
        assert status == 200
        np.testing.assert_array_equal(np.frombuffer(content[split:], np.float32).reshape(wanted.shape), wanted)
    assert successes() == before + 3
    assert PATH not in usual


def test_a_request_in_pieces_takes_the_usual_way_to_the_same_answer(
    service: tuple[Station, str], usual: list[str]
) -> None:
    def until_begun() -> None:
        deadline = time.monotonic() + 30
        while PATH not in usual and time.monotonic() < deadline:
            time.sleep(0.002)

    content, headers = body(arrays(7))
    assert asked(service[1], content, headers, until_begun) == asked(service[1], content, headers)
    assert usual.count(PATH) == 1


@settings(max_examples=15, deadline=None)
@given(request=junk | st.fixed_dictionaries({"inputs": st.lists(junk, max_size=3)}), tail=st.binary(max_size=40))
def test_nothing_is_answered_otherwise_because_it_came_whole(
    service: tuple[Station, str], request: object, tail: bytes
) -> None:
    head = json.dumps(request).encode()
    for headers in ({}, {"Inference-Header-Content-Length": str(len(head))}):
        whole = asked(service[1], head + tail, headers)
        assert whole[0] == 400
        assert whole == asked(service[1], head + tail, headers, lambda: time.sleep(0.002))


def test_of_requests_that_come_in_one_batch_the_first_is_answered_at_once_and_all_in_order(
    service: tuple[Station, str], usual: list[str]
) -> None:
    host, port = service[1].split(":")
    batch, wanted = b"", []
    for seed in range(BATCH_N):
        content, headers = body(arrays(seed))
        wanted.append(asked(service[1], content, headers)[2])
        last = {"Connection": "close"} if seed == BATCH_N - 1 else {}
        lines = {"Host": host, "Content-Length": str(len(content))} | headers | last
        head = f"POST {PATH} HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in lines.items())
        batch += head.encode() + b"\r\n" + content
    said = b""
    with socket.create_connection((host, int(port)), 30) as link:
        link.sendall(batch)
        while piece := link.recv(1 << 16):
            said += piece
    assert said.count(b"HTTP/1.1 200") == BATCH_N
    assert sorted(wanted, key=said.index) == wanted
    assert usual.count(PATH) >= 1


def test_a_token_and_a_rate_are_asked_for_on_the_short_way_too(tmp_path: Path) -> None:
    with small_service(tmp_path, token_drive="d" * 20, requests_per_s=0.001) as (_, place):
        content, headers = body(arrays(0))
        assert asked(place, content, headers)[0] == 401
        known = headers | {"Authorization": "Bearer " + "d" * 20}
        assert asked(place, content, known)[0] == 200
        assert asked(place, content, known)[0] == 429


def test_a_request_that_is_refused_counts_once(tmp_path: Path) -> None:
    with small_service(tmp_path, requests_per_s=1.0) as (_, place):
        assert [asked(place, b"{}", {})[0] for _ in range(2)] == [400, 400]
