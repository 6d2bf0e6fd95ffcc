"""A press on hand-made gels in a session with the released networks: any rate, standstill, late or torn frames."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from service.contract import FINGERS, Finger, FramePair, Sensor, TactileFrame, wire
from service.decision.models import ModelSet, load_models
from service.perception.markers.field import MarkerField, field_from_gel
from service.perception.observation import Observation
from service.perception.slip.detector import SlipDetector
from service.perception.slip.onset import OnsetDetector
from service.session.state_machine import InsertionSession
from tests.hard_cases.registry import ROOT
from tests.service import drawn

SENSOR = Sensor.load()
FOLDERS = ("pressing", "pressing/joint")
TOUCH_MM, END_MM = 3.0, 4.5
CARRIED, TURNED = 0.5, np.deg2rad(1.5) * SENSOR.marker_pitch_mm  # of the gel under the object, for each mm of press
NAMED: dict[str, Any] = {"insertion_id": "press", "attempt": 1}
PIXELS = np.zeros((320, 327, 3), np.uint8)
Marked = Callable[[MarkerField, float], MarkerField]
Answer = wire.Correction | wire.NoDecision | wire.Refused


@lru_cache
def pressing(folder: str) -> ModelSet:
    """A released set of networks that read depth, opened once."""
    return load_models(ROOT / "models" / folder)


class Gels:
    """A finger's perception that is handed its fields, by the frames' numbers."""

    gel_distance: float | None = None

    def __init__(self, finger: Finger, fields: list[MarkerField]) -> None:
        self._finger, self._fields, self._rearm = finger, fields, False
        self._slip, self._onset = SlipDetector(), OnsetDetector()

    def rearm(self) -> None:
        self._rearm = True

    def observe(self, frame: TactileFrame) -> Observation:
        field, onset_ns = self._fields[frame.seq], None
        if self._rearm:
            slip, self._rearm = self._slip.rearm(field), False
            self._onset.rearm(field)
        else:
            slip, onset_ns = self._slip.update(field), self._onset.update(field)
        return Observation(self._finger, frame.seq, frame.captured_ns, PIXELS, field, slip, onset_ns, {})


@dataclass(frozen=True)
class Press:
    """A descent that touches after `TOUCH_MM`; ``reach_mm`` is what the client states.

    ``stands``: depth at which the arm stands, and for how long. ``late``: every other frame of the press is followed by
    one that is stamped as the first was, and shows a gel torn off. ``marked`` changes each finger's fields, by the
    depth of the press.
    """

    seed: int
    fps: float = 30.0
    speed_mm_s: float = 10.0
    reach_mm: float | None = None
    stands: tuple[float, float] = (END_MM, 0.0)
    late: bool = False
    marked: tuple[Marked | None, Marked | None] = (None, None)

    @property
    def standing_s(self) -> tuple[float, float]:
        """When the arm begins to stand, and when it goes on."""
        begin_s = self.stands[0] / self.speed_mm_s
        return begin_s, begin_s + self.stands[1]

    def pressed_mm(self, at_s: float) -> float:
        begin_s, end_s = self.standing_s
        going_s = at_s - min(max(0.0, at_s - begin_s), end_s - begin_s)
        return max(0.0, self.speed_mm_s * going_s - TOUCH_MM)

    def frames(self) -> Iterator[tuple[int, tuple[MarkerField, MarkerField]]]:
        """When a pair comes, and its fields, which are stamped with their capture."""
        for number, at_s in enumerate(np.arange(0.0, END_MM / self.speed_mm_s + self.stands[1], 1.0 / self.fps)):
            pair = self._field(0, float(at_s)), self._field(1, float(at_s))
            yield round(1e9 * at_s), pair
            if self.late and number % 2 and self.pressed_mm(float(at_s)):
                torn = [replace(one, captured_ns=0, displacement_px=one.displacement_px + 1e4) for one in pair]
                yield round(1e9 * at_s), (torn[0], torn[1])

    def _field(self, side: int, at_s: float) -> MarkerField:
        pressed_mm = self.pressed_mm(at_s)
        gel = drawn.gel(CARRIED * pressed_mm)
        rows, columns = np.mgrid[0:20, 0:21]
        under = np.clip(1.6 * (1.3 - np.hypot((rows - 9.5) / 8.0, (columns - 10.0) / 8.5)), 0, 1)
        turned = (1, -1)[side] * TURNED * pressed_mm * under
        gel[..., 0] -= turned * (rows - 9.5)
        gel[..., 1] += turned * (columns - 10.0)
        noise = np.random.default_rng((self.seed, side, round(1e6 * at_s))).normal(0, 1e-3, (20, 21, 2))
        gel[..., :2] += noise
        field, marked = field_from_gel(gel, round(1e9 * at_s), SENSOR), self.marked[side]
        return marked(field, pressed_mm) if marked else field

    def answer(self, folder: str) -> Answer:
        """What the session with the networks of a folder says at last: a correction, or why there is none."""
        frames = list(self.frames())
        eyes: list[Any] = [Gels(finger, [pair[side] for _, pair in frames]) for side, finger in enumerate(FINGERS)]
        session = InsertionSession(pressing(folder), *eyes)
        stated = {"gap_width_mm": 56.0, "grasp_height_mm": 40.0, "grip_n": 20.0, "shear_reach_mm": self.reach_mm}
        session.handle(wire.ClientHello(insertion_id="press", client="press"), 0)
        replies = session.handle(wire.Arm.model_validate(NAMED | stated | {"expected_depth_mm": 25.0}), 0)
        for number, (now_ns, (left, right)) in enumerate(frames):
            stamps = (left.captured_ns, right.captured_ns)
            pair = [TactileFrame(f, number, ns, PIXELS) for f, ns in zip(FINGERS, stamps, strict=True)]
            replies += session.on_pair(FramePair(*pair), now_ns)
            if number == 0:
                replies += session.handle(wire.Descending(**NAMED, speed_mm_s=self.speed_mm_s), now_ns)
            stops = number == len(frames) - 1 or any(one.type in ("slip", "enough") for one in replies)
            replies += self._goes_on(session, now_ns, stops=stops)
            if stops:
                break
        replies += session.handle(wire.Stopped(**NAMED, depth_mm=END_MM, outcome="blocked"), now_ns)
        replies += session.on_tick(now_ns + 60_000_000_000)
        return next(one for one in replies if isinstance(one, Answer))

    def _goes_on(self, session: InsertionSession, now_ns: int, *, stops: bool) -> list[Any]:
        """The client says for how long the arm stood, once it goes on, or if it is stopped meanwhile."""
        begin_s, end_s = self.standing_s
        here_s, before_s = now_ns * 1e-9, now_ns * 1e-9 - 1.0 / self.fps
        if not self.stands[1] or not (before_s < end_s <= here_s or (stops and begin_s < here_s < end_s)):
            return []
        stood_s = min(here_s, end_s) - begin_s
        paused = wire.Descending(**NAMED, speed_mm_s=self.speed_mm_s, paused_s=stood_s)
        return session.handle(paused, round(min(here_s, end_s) * 1e9))
