"""A robot client as short as the protocol allows, for tests of the live service."""

import time
from typing import Any, Self

from websockets.sync.client import ClientConnection, connect

from service.contract import wire
from tests.service.conftest import LiveService

CELL: dict[str, Any] = {"gap_width_mm": 56.0, "neighbours_stay": True}
FRESH_NS = 100_000_000


class Driver:
    def __init__(self, live: LiveService, insertion_id: str, **hello: Any) -> None:
        self.live, self.id = live, insertion_id
        if station := getattr(live, "station", None):  # not of a process of its own, which has held nothing before
            station.manager.held_over = ""  # this client has no gripper to open: each test grasps its object anew
        self.socket: ClientConnection = connect(
            live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None
        )
        self.send(wire.ClientHello(insertion_id=insertion_id, client="test", **hello))

    def send(self, message: Any) -> None:
        self.socket.send(message.model_dump_json())

    def receive(self, timeout_s: float = 60.0) -> Any:
        return wire.parse_service(self.socket.recv(timeout_s))

    def until(self, kind: str, timeout_s: float = 60.0) -> Any:
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            message = self.receive(left)
            if message.type == kind:
                return message
            assert message.type not in {"fault", "no_decision", "refused"}, message
        raise AssertionError(f"no {kind} within {timeout_s} s")

    def arms(self, number: int, expected_depth_mm: float = 25.0) -> None:
        self.rest()
        self.send(wire.Arm(insertion_id=self.id, attempt=number, **CELL, expected_depth_mm=expected_depth_mm))
        self.until("armed")

    def attempt(self, number: int) -> wire.Correction:
        self.arms(number)
        self.live.probe()
        self.send(wire.Descending(insertion_id=self.id, attempt=number))
        slip = self.until("slip")
        self.send(wire.Stopped(insertion_id=self.id, attempt=number, depth_mm=3.0, outcome="blocked"))
        correction = self.until("correction")
        assert slip.attempt == correction.attempt == number
        return correction

    def after(self, attempts_n: int) -> Self:
        """Itself, once so many attempts have been decided."""
        for number in range(1, attempts_n + 1):
            self.attempt(number)
        return self

    def rest(self) -> None:
        for finger in self.live.fingers:
            finger.probe_started = None
        time.sleep(0.2)  # three frames: none of before is still on its way

    def insert(self, number: int) -> wire.Finished:
        """Full depth of 1 mm, so slow that a stalling machine misses nothing that counts.

        Full depth is believed of a descent that was watched, on a frame that is recent.
        """
        self.arms(number, expected_depth_mm=1.0)
        self.send(wire.Descending(insertion_id=self.id, attempt=number))
        time.sleep(0.3)
        while time.monotonic_ns() - self.until("watching").frame_captured_ns > FRESH_NS:
            pass
        self.send(wire.Stopped(insertion_id=self.id, attempt=number, depth_mm=1.0, outcome="inserted"))
        return self.until("finished")

    def gives_up(self, cause: wire.Cause = "operator", reason: str = "done") -> wire.Finished:
        """Abort, and leave once that is confirmed."""
        self.send(wire.Abort(insertion_id=self.id, cause=cause, reason=reason))
        finished: wire.Finished = self.until("finished")
        self.close()
        return finished

    def close(self) -> None:
        self.socket.close()


def greeted(live: LiveService, insertion_id: str, **hello: Any) -> Driver:
    """A client that was greeted: its insertion is open."""
    driver = Driver(live, insertion_id, **hello)
    driver.until("hello")
    return driver
