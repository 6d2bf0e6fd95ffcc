"""The controller that docs/api.md teaches, against something that only answers it: what needs no service to be true."""

import contextlib
import json
import threading
import time
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from tests.examples.cell import controller
from tests.examples.tiny_arm import TinyArm
from tests.waiting import wait_for

CLOCK = {"sent_ns": 1, "service_ns": 1}  # one clock for both
LIMITS = {"max_dx_mm": 15.0, "max_dtheta_deg": 15.0}
ANSWERS: dict[str, list[dict[str, Any]]] = {
    "hello": [{"type": "hello", "protocol": 2, "cameras": [], "limits": LIMITS, "clock": CLOCK}],
    "heartbeat": [{"type": "heartbeat", "clock": None}],
    "learn_open": [{"type": "open_learnt"}],
    "arm": [{"type": "refused", "reason": "nothing_held", "detail": "both gels look untouched"}],
}


class Answering:
    """Answers each message by its type, with the time as the stamp of all frames, and may ping its client."""

    def __init__(self, **answers: list[dict[str, Any]]) -> None:
        self.answers, self.answered_n = ANSWERS | answers, 0
        self.server = serve(self._answer, "127.0.0.1", 0, ping_interval=None)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def _answer(self, link: ServerConnection) -> None:
        self.link = link
        with contextlib.suppress(ConnectionClosed):
            for text in link:
                for answer in self.answers.get(json.loads(text)["type"], []):
                    link.send(json.dumps(answer | {"attempt": 1, "frame_captured_ns": time.monotonic_ns()}))
                    self.answered_n += 1

    def hears_a_pong_after(self, answers_n: int) -> bool:
        wait_for(lambda: self.answered_n >= answers_n)
        return self.link.ping().wait(10.0)

    def held(self, arm: TinyArm, depth_mm: float = 4.0) -> str:
        """Why an insertion of the example's with this arm is held."""
        task = controller.Task("box", gap_width_mm=56.0, depth_mm=depth_mm, speed_mm_s=0.5)
        url = f"ws://127.0.0.1:{self.server.socket.getsockname()[1]}/v1/insertion"
        with self.server, pytest.raises(controller.Held) as held:
            controller.insert(arm, "token", task, url)
        return str(held.value)


def test_an_arm_that_takes_long_to_pick_its_object_loses_no_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers to the heartbeats wait for it meanwhile; a service that hears no pong for 20 s closes."""
    monkeypatch.setattr(controller, "HEARTBEAT_S", 0.005)
    arm, service, heard = TinyArm(), Answering(), list[bool]()
    arm.on_grasp = lambda: heard.append(service.hears_a_pong_after(50))
    assert service.held(arm).startswith("nothing_held")
    assert heard == [True]


def test_a_proxy_of_the_environment_is_not_asked_for_the_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    monkeypatch.setenv("no_proxy", "")
    assert Answering().held(TinyArm()).startswith("nothing_held")


def test_nothing_moves_after_the_last_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its correction is followed by `finished`, on which the page says to hold."""
    monkeypatch.setattr(controller, "ATTEMPTS", 1)
    correction = {"type": "correction", "dx_mm": 2.0, "dtheta_deg": 1.0}
    ended = {"type": "finished", "outcome": "failed", "cause": "attempts", "doubts": []}
    arm = TinyArm()
    service = Answering(arm=[{"type": "armed"}], descending=[{"type": "enough"}], stopped=[correction, ended])
    assert service.held(arm) == "not inserted after 1 attempts"
    assert arm.stopped
    assert (arm.retracted, arm.moves) == (0, [])


def test_at_full_depth_it_waits_as_long_as_a_slow_disk_may_take_for_the_recording(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert controller.FINISHED_S == 30.0, "as docs/api.md asks"
    monkeypatch.setattr(controller, "ANSWER_S", 0.1)
    monkeypatch.setattr(controller, "FINISHED_S", 0.2)
    service = Answering(arm=[{"type": "armed"}])
    assert service.held(TinyArm(), depth_mm=0.9) == "no finished within 0.2 s"
    blocked = Answering(arm=[{"type": "armed"}], descending=[{"type": "slip"}])
    assert blocked.held(TinyArm()) == "no correction or no_decision within 0.1 s"
