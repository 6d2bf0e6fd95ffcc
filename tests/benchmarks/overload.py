"""A station given twice the frames it can perceive, and the age of each result it gives."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from itertools import cycle
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import Capture, now_ns
from service.cli.run import SWITCH_S
from service.contract import FINGERS, Finger, wire
from service.perception.observation import Observation
from service.perception.rectification import Rectifier
from service.session.station import Station
from tests.service import drawn

SECONDS = 6.0
LEARN_S = 2.0  # with frames as fast as they can be shown, to learn how many are perceived
WARM_PAIRS = 40
PICTURES = 16
CALM_NS = 200_000  # the kernel may keep the perceiving thread waiting so long, and the result still counts as calm


class Waited:
    """How long the kernel has let a thread wait for a core; 0 if it does not report it."""

    def __init__(self) -> None:
        self._file: int | None = None

    def of_this_thread(self) -> None:
        path = f"/proc/self/task/{threading.get_native_id()}/schedstat"
        self._file = os.open(path, os.O_RDONLY) if os.path.exists(path) else None  # noqa: PTH110

    def ns(self) -> int:
        return 0 if self._file is None else int(os.pread(self._file, 64, 0).split()[1])


class Results:
    """Listens to the hub: when each frame was perceived, its cost, and whether other processes had the core."""

    def __init__(self, station: Station) -> None:
        self.rows: list[tuple[int, int, float, int, Finger]] = []
        self.armed = threading.Event()
        self.waited = Waited()
        self.waited_at: dict[int, int] = {}
        station.hub.subscribe(self.heard)
        station.post(self.waited.of_this_thread)

    def heard(self, kind: str, content: Any) -> None:
        if isinstance(content, Observation):
            waited_ns = self.waited.ns() - self.waited_at.get(content.captured_ns, 0)
            step_ms = sum(content.cost_ms.values())
            self.rows.append((content.captured_ns, now_ns(), step_ms, waited_ns, content.finger))
        elif kind == "message" and content.type == "armed":
            self.armed.set()


def pictures(finger: Finger) -> Iterator[tuple[NDArray[np.uint8], bytes]]:
    """A still gel with a little noise, over and over, with the JPEG that a camera would have sent."""
    still = Rectifier(drawn.calibration().camera(finger)).apply(drawn.raw(finger, 0, 10, 16))
    rng, made = np.random.default_rng(0), []
    for _ in range(PICTURES):
        picture = still.copy()
        picture[:2] = rng.integers(0, 255, picture[:2].shape, np.uint8)  # a frozen camera would be noticed
        made.append((picture, cv2.imencode(".jpg", picture)[1].tobytes()))
    return cycle(made)


class Producer:
    """Both cameras, driven from here so that "twice" is known; their frames are made beforehand."""

    def __init__(self, station: Station, results: Results) -> None:
        self._station, self._results = station, results
        self._pictures = {finger: pictures(finger) for finger in FINGERS}
        self.stamps: list[int] = []

    def show(self) -> None:
        stamp = now_ns()
        self._results.waited_at[stamp] = self._results.waited.ns()
        self.stamps.append(stamp)
        for finger in FINGERS:
            pixels, jpeg = next(self._pictures[finger])
            self._station.cameras[finger]._publish(Capture(stamp, pixels, jpeg))

    def run(self, period_s: float, seconds: float) -> None:
        due = time.monotonic()
        until = due + seconds
        while time.monotonic() < until:
            self.show()
            due = max(due + period_s, time.monotonic() - period_s)  # missed frames are not made up for in a burst
            time.sleep(max(0.0, due - time.monotonic()))


def age_at_twice_the_load(station: Station) -> dict[str, Any]:
    """Perceive some pairs at leisure, then at full speed to learn the rate that can be had, then at twice that rate."""
    results = Results(station)
    producer = Producer(station, results)
    sys.setswitchinterval(SWITCH_S)  # as `python -m service run` does

    def send(message: Any) -> None:
        del message

    station.connect(wire.ClientHello(insertion_id="over", client="bench", purpose="probe"), send)
    arm = wire.Arm(insertion_id="over", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    station.receive(arm, send)
    deadline = time.monotonic() + 30
    while not results.armed.is_set() and time.monotonic() < deadline:
        producer.run(0.1, 0.1)
    producer.run(0.05, 0.05 * WARM_PAIRS)
    pair_ms = 2 * float(np.median([step_ms for _, _, step_ms, _, _ in results.rows[WARM_PAIRS // 2 :]]))
    done_n = len(results.rows)
    producer.run(pair_ms / 4e3, LEARN_S)
    rate = max(1, len(results.rows) - done_n) / LEARN_S
    done_n, shown = len(results.rows), len(producer.stamps)
    producer.run(1 / rate, SECONDS)  # a pair is two frames, and twice the rate is wanted
    return summary(results.rows[done_n:], producer.stamps[shown:], pair_ms)


def summary(rows: list[tuple[int, int, float, int, Finger]], stamps: list[int], pair_ms: float) -> dict[str, Any]:
    """Ages against one frame and one step; a step is what perceiving the two frames of a pair took at that moment."""
    age = np.array([(done - captured) / 1e6 for captured, done, _, _, _ in rows])
    step = np.array([step_ms for _, _, step_ms, _, _ in rows])
    calm = np.array([waited for _, _, _, waited, _ in rows]) <= CALM_NS
    period_ms = (stamps[-1] - stamps[0]) / 1e6 / (len(stamps) - 1)
    bound = period_ms + step + np.concatenate([step[:1], step[:-1]])
    within = age <= bound
    return {
        "pair_costs_ms": round(pair_ms, 2),
        "pair_every_ms": round(period_ms, 2),
        "frames_shown": 2 * len(stamps),
        "frames_perceived": len(age),
        "age_p50_ms": round(float(np.median(age)), 2),
        "age_p99_ms": round(float(np.percentile(age, 99)), 2),
        "times_overloaded": round(2 * len(stamps) / max(len(age), 1), 1),
        "one_frame_and_one_step_ms": round(float(np.median(bound)), 2),
        "one_frame_and_one_step_p99_ms": round(float(np.percentile(bound, 99)), 2),
        "share_within": round(float(within.mean()), 4),
        "share_calm": round(float(calm.mean()), 3),
        "share_within_of_calm": round(float(within[calm].mean()), 4) if calm.any() else None,
    }
