"""A station given twice the frames it can perceive, and the age of each result it gives."""

import sys
import threading
import time
from typing import Any

import numpy as np

from service.cameras import Capture, now_ns
from service.contract import FINGERS, wire
from service.observation import Observation
from service.perception.rectify import Rectifier
from service.run import SWITCH_S
from service.station import Station
from tests.service import drawn

SECONDS = 6.0
WARM_PAIRS = 40


class Ages:
    """Listens to the hub: when was each frame perceived, and what did it cost?"""

    def __init__(self, station: Station) -> None:
        self.age_ms: list[float] = []
        self.step_ms: list[float] = []
        self.armed = threading.Event()
        station.hub.subscribe(self.heard)

    def heard(self, kind: str, content: Any) -> None:
        if isinstance(content, Observation):
            self.age_ms.append((now_ns() - content.captured_ns) / 1e6)
            self.step_ms.append(sum(content.cost_ms.values()))
        elif kind == "message" and content.type == "armed":
            self.armed.set()


def age_at_twice_the_load(station: Station) -> dict[str, Any]:
    """Perceive some pairs at leisure to learn the cost of one, then feed pairs in half that time."""
    rectifiers = {finger: Rectifier(drawn.calibration().camera(finger)) for finger in FINGERS}
    still = {finger: rectifiers[finger].apply(drawn.raw(finger, 0, 10, 16)) for finger in FINGERS}
    rng = np.random.default_rng(0)
    ages = Ages(station)
    sys.setswitchinterval(SWITCH_S)  # as `python -m service run` does

    def show() -> None:
        for finger in FINGERS:
            picture = still[finger].copy()
            picture[:2] = rng.integers(0, 255, picture[:2].shape, np.uint8)  # a frozen camera would be noticed
            station.cameras[finger]._publish(Capture(now_ns(), picture))

    def send(message: Any) -> None:
        del message

    station.connect(wire.ClientHello(insertion_id="over", client="bench"), send)
    arm = wire.Arm(insertion_id="over", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    station.receive(arm, send)
    deadline = time.monotonic() + 30
    while not ages.armed.is_set() and time.monotonic() < deadline:
        show()
        time.sleep(0.1)
    ages.age_ms.clear()
    ages.step_ms.clear()
    for _ in range(WARM_PAIRS):
        show()
        time.sleep(0.1)
    pair_ms = 2 * float(np.median(ages.step_ms))
    seen = len(ages.age_ms)
    period_s, due = pair_ms / 2 / 1e3, time.monotonic()
    shown, until = 0, time.monotonic() + SECONDS
    while time.monotonic() < until:
        show()
        shown += 1
        due += period_s
        time.sleep(max(0.0, due - time.monotonic()))
    age, step = np.array(ages.age_ms[seen:]), np.array(ages.step_ms[seen:])
    period_ms = SECONDS * 1e3 / shown
    # a step is what perceiving the two frames of a pair took at that moment, with whatever else ran on the machine
    bound = period_ms + step + np.concatenate([step[:1], step[:-1]])
    return {
        "pair_costs_ms": round(pair_ms, 2),
        "pair_every_ms": round(period_ms, 2),
        "frames_shown": 2 * shown,
        "frames_perceived": len(age),
        "age_p50_ms": round(float(np.median(age)), 2),
        "age_p99_ms": round(float(np.percentile(age, 99)), 2),
        "times_overloaded": round(2 * shown / max(len(age), 1), 1),
        "one_frame_and_one_step_ms": round(float(np.median(bound)), 2),
        "one_frame_and_one_step_p99_ms": round(float(np.percentile(bound, 99)), 2),
        "share_within": round(float(np.mean(age <= bound)), 3),
    }
