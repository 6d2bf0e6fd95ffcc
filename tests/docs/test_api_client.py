"""The client printed in docs/api.md: its messages parse, slip stops it, a correction moves it once."""

import threading
import time
from functools import partial

import pytest
from websockets.sync.server import ServerConnection, serve

from service.contract import wire
from service.contract.replies import clock
from tests.docs.commands import ROOT, blocks

DEPTH_MM = 25.0
TOKEN = "a-token-for-driving"


class Arm:
    """Blocked at 6 mm on its first attempt, free afterwards; moves 0.5 mm each time it is asked."""

    speed_mm_s = 10.0

    def __init__(self):
        self.moves: list[tuple[float, float]] = []
        self.retracted = 0
        self._depth_mm = 0.0
        self._to_mm = 0.0

    def start_descent(self, depth_mm: float):
        self._depth_mm, self._to_mm = 0.0, depth_mm

    def descending(self) -> bool:
        limit_mm = self._to_mm if self.moves else min(self._to_mm, 6.0)
        self._depth_mm = min(self._depth_mm + 0.5, limit_mm)
        return self._depth_mm < self._to_mm

    def stop(self):
        self._to_mm = self._depth_mm

    def depth_mm(self) -> float:
        return self._depth_mm

    def retract(self):
        self.retracted += 1

    def move_by(self, dx_mm: float, dtheta_deg: float):
        self.moves.append((dx_mm, dtheta_deg))


def now(**more: int) -> dict[str, int]:
    return {"frame_captured_ns": time.monotonic_ns(), **more}


def heard(link: ServerConnection, attempt: int, watches: bool):
    """The next message of the client; while its second descent goes on, `watching` goes out."""
    while True:
        try:
            return wire.parse_client(link.recv(0.02))
        except TimeoutError:
            if attempt and watches:
                watching = wire.Watching(insertion_id="demo-1", attempt=attempt, judged_ns=0, **now())
                link.send(watching.model_dump_json())


def script(link: ServerConnection, watches: bool = True):
    """A service that sees slip on the first attempt and corrects it; raises on any message out of the contract."""
    descending = 0
    while True:
        said = heard(link, descending, watches)
        descending = said.attempt if isinstance(said, wire.Descending) else 0
        head = {"insertion_id": said.insertion_id}
        match said:
            case wire.ClientHello():
                limits = wire.Limits(max_dx_mm=15, max_dtheta_deg=15, max_frame_age_ms=250)
                answer = wire.ServiceHello(
                    models=(),
                    cameras=(),
                    controller="belief",
                    limits=limits,
                    clock=clock(said, time.monotonic_ns()),
                    **head,
                )
            case wire.LearnOpen():
                answer = wire.OpenLearnt(**head)
            case wire.Arm():
                answer = wire.Armed(attempt=said.attempt, **now(reference_seq=7), **head)
            case wire.Descending(attempt=1):
                moment = {"frame_seq": 9, "captured_ns": 1, "age_ms": 12.0, "score": 8.0, "reason": "9 markers"}
                answer = wire.Slip(attempt=1, finger="left", **moment, **head)
            case wire.Stopped(outcome="blocked"):
                answer = wire.Correction(
                    attempt=said.attempt,
                    dx_mm=-2.0,
                    dtheta_deg=1.0,
                    class_probabilities={"1": 1.0},
                    estimate=wire.Estimate(dx_mm=2.9, dtheta_deg=-1.4),
                    confidence=1.0,
                    controller="belief",
                    reason="test",
                    latency_ms={},
                    **head,
                )
            case wire.Stopped():
                answer = wire.Finished(outcome="inserted", attempts=said.attempt, **head)
            case _:
                continue
        link.send(answer.model_dump_json())
        if isinstance(answer, wire.Finished):
            return


@pytest.fixture(params=[True])
def url(request):
    with serve(partial(script, watches=request.param), "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}/v1/insertion"
        server.shutdown()
        thread.join()


@pytest.fixture
def insert():
    (block,) = [block for block in blocks(ROOT / "docs" / "api.md") if block.language == "python"]
    space: dict = {}
    exec(compile(block.text, block.name, "exec"), space)
    return space["insert"]


@pytest.mark.parametrize("url", [False], indirect=True)
def test_the_documented_client_stops_where_nobody_watches(url: str, insert):
    arm = Arm()
    with pytest.raises(RuntimeError, match="nobody watches"):
        insert(arm, TOKEN, url)
    assert not arm.descending()
    assert arm.depth_mm() < DEPTH_MM - 1.0


def test_the_documented_client_stops_on_slip_and_corrects_once(url: str, insert):
    arm = Arm()
    assert insert(arm, TOKEN, url)["outcome"] == "inserted"
    assert arm.moves == [(-2.0, 1.0)]
    assert arm.retracted == 1
    assert arm.depth_mm() == DEPTH_MM
