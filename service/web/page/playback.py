"""Playback of a recorded insertion: curves on one time axis, and both fingers' observations at any moment of it."""

import json
from bisect import bisect_left
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import McapReader

from service.contract import FINGERS, ContractError, Finger
from service.contract.wire import parse_service
from service.perception.rectification import Calibration, Rectifier
from service.recordings.reader import RecordingError, opened, pixels_of
from service.recordings.schemas import Markers
from service.recordings.writer import IMAGE
from service.web.page.broadcast import kinds, shown
from service.web.page.sentences import event

PERIOD_NS = 50_000_000  # of the selectable moments; a picture further off is of another one
USUAL_SHAPE = (320, 327, 3)  # of a rectified frame, where no calibration states it
TOPICS = [*(f"/{finger}/markers" for finger in FINGERS), "/robot", "/messages"]
UNFELT: dict[str, Any] = {"rest": [], "moved": [], "kinds": [], "pitch": 0.0}
"""The markers of a picture that was not judged."""


class Curves:
    """Collects the curves of a recording. Times are in ns until output. ``earlier_n``: as of `sentences.event`."""

    def __init__(self, earlier_n: int = 0) -> None:
        self._earlier_n = earlier_n
        self.slip: dict[str, list[tuple[int, float]]] = {finger: [] for finger in FINGERS}
        self.push: dict[str, list[tuple[int, float]]] = {finger: [] for finger in FINGERS}
        self.depth: list[tuple[int, float]] = []
        self.events: list[tuple[int, str]] = []
        self._examined: dict[str, list[int]] = {finger: [] for finger in FINGERS}
        self._rest: dict[str, float] = {}

    def markers(self, finger: str, at_ns: int, data: bytes) -> None:
        """Slip, and the upward shear of the gel since the attempt began, in marker pitches.

        Where no marker is visible, only that the finger was examined.
        """
        self._examined[finger].append(at_ns)
        markers = Markers.FromString(data)
        moved = np.array(markers.displacement_px, np.float32).reshape(-1, 2)
        valid = np.frombuffer(markers.valid, np.uint8) > 0
        if not valid.any():
            return
        up = -float(moved[valid, 1].mean()) / _pitch(markers)
        self.slip[finger].append((at_ns, markers.slip_score))
        self.push[finger].append((at_ns, up - self._rest.setdefault(finger, up)))

    def robot(self, at_ns: int, depth_mm: float | None) -> None:
        if depth_mm is not None:
            self.depth.append((at_ns, depth_mm))

    def message(self, at_ns: int, sender: str, message: dict[str, Any]) -> None:
        """A message of either side; the client's `arm` begins an attempt, whose gels are at rest."""
        if sender == "client" and message["type"] == "arm":
            self._rest.clear()
        elif sender == "client" and message["type"] == "abort":
            self.events.append((at_ns, message["reason"]))
        elif sender == "service" and (entry := _line(message, self._earlier_n)):
            self.events.append((at_ns, entry))

    def as_json(self) -> dict[str, Any]:
        """Seconds since the first of all points, and values; ``moments`` are the stamps of both fingers' frames."""
        firsts = [stamps[0] for stamps in self._examined.values() if stamps] + [at for at, _ in self.depth[:1]]
        start_ns = min(firsts + [at for at, _ in self.events], default=0)

        def of(points: list[tuple[int, float]]) -> list[list[float]]:
            return [[round((at - start_ns) / 1e9, 3) for at, _ in points], [round(value, 4) for _, value in points]]

        return {
            "slip": {finger: of(points) for finger, points in self.slip.items()},
            "push": {finger: of(points) for finger, points in self.push.items()},
            "depth": of(self.depth),
            "events": [{"t": round((at - start_ns) / 1e9, 3), "text": text} for at, text in self.events],
            "moments": list(self._moments(start_ns)),
        }

    def _moments(self, start_ns: int) -> Iterator[dict[str, Any]]:
        """At most one per ``PERIOD_NS`` at which a finger was examined; None for one that was not, within that time.

        Stamps are text, because JavaScript numbers cannot hold them.
        """
        last_ns = -PERIOD_NS
        for at_ns in sorted({at for stamps in self._examined.values() for at in stamps}):
            if at_ns - last_ns >= PERIOD_NS:
                last_ns = at_ns
                near: dict[str, Any] = {finger: _nearest(self._examined[finger], at_ns) for finger in FINGERS}
                yield {"t": round((at_ns - start_ns) / 1e9, 3)} | near


def _nearest(stamps: list[int], at_ns: int) -> str | None:
    """The stamp nearest to a time, None if it is of another moment: the next one may come seconds later."""
    after = bisect_left(stamps, at_ns)
    off_ns, stamp = min(((abs(one - at_ns), one) for one in stamps[max(0, after - 1) : after + 1]), default=(0, None))
    return str(stamp) if stamp is not None and off_ns <= PERIOD_NS else None


def _line(message: dict[str, Any], earlier_n: int) -> str:
    """The line of a message of the service; of one that another version sent, at least its name."""
    try:
        return event(parse_service(json.dumps(message)), earlier_n)
    except ContractError:
        return f"{message['type']}, from another version of the service".replace("_", " ")


def timeline(path: Path, earlier_n: int = 0) -> dict[str, Any]:
    """The curves of a recording; raises RecordingError if it cannot be read.

    ``earlier_n``: attempts with the object in its earlier grasps, from which its own are counted on. ``open``: the
    stamp of each finger's first picture, which is of its open gel if the hand was open then.
    """
    curves = Curves(earlier_n)
    with opened(path) as reader:
        first = {finger: next(_messages(reader, _images(finger)), None) for finger in FINGERS}
        for topic, at_ns, data in _messages(reader, TOPICS):
            match topic:
                case "/robot":
                    curves.robot(at_ns, json.loads(data)["depth_mm"])
                case "/messages":
                    content = json.loads(data)
                    curves.message(at_ns, content["from"], content["message"])
                case _:
                    curves.markers(topic.split("/")[1], at_ns, data)
    return curves.as_json() | {"open": {finger: str(one[1]) for finger, one in first.items() if one}}


def moment(path: Path, finger: Finger, at_ns: int) -> dict[str, Any]:
    """A finger's picture and observation at a stamp of the timeline, as the page draws it.

    RecordingError if there is neither.
    """
    pixels, markers = None, None
    with opened(path) as reader:
        calibration = next((m.metadata["calibration"] for m in reader.iter_metadata() if m.name == "insertion"), "")
        for topic, _, data in _messages(reader, [f"/{finger}/markers", *_images(finger)], at_ns):
            if topic.endswith("markers"):
                markers = Markers.FromString(data)
            else:
                pixels = pixels_of(topic, data)
    if markers is None and pixels is None:
        raise RecordingError(f"{path.parent.name} has nothing of the {finger} finger at {at_ns}")
    rectify = _rectifier(calibration, finger) if calibration else None
    if pixels is None:  # dropped for lack of space: the markers remain
        pixels = np.zeros(rectify.camera.rectified.shape if rectify else USUAL_SHAPE, np.uint8)
    elif rectify and pixels.shape == rectify.camera.raw.shape:
        pixels = rectify.apply(pixels)
    if markers is None:
        return shown(finger, pixels, "watching", 0.0) | UNFELT
    flags = (np.frombuffer(each, np.uint8) for each in (markers.valid, markers.slipping, markers.sticking))
    arrows = {
        "rest": [round(v, 1) for v in markers.rest_px],
        "moved": [round(v, 2) for v in markers.displacement_px],
        "kinds": kinds(*flags),
        "pitch": _pitch(markers),
    }
    return shown(finger, pixels, markers.state, markers.slip_score) | arrows


def _images(finger: Finger) -> list[str]:
    return [f"/{finger}/{name}" for name in IMAGE.values()]


def _messages(reader: McapReader, topics: list[str], at_ns: int | None = None) -> Iterator[tuple[str, int, bytes]]:
    """(topic, log time, bytes) in order of time, of all times or of one."""
    end_ns = None if at_ns is None else at_ns + 1
    for _, channel, message in reader.iter_messages(topics, at_ns, end_ns):
        yield channel.topic, message.log_time, message.data


def _pitch(markers: Any) -> float:
    """Distance of neighbouring markers at rest, px; 0 without any."""
    rest = np.array(markers.rest_px, np.float32).reshape(markers.rows, markers.cols, 2)
    apart = rest[:, 1:, 0] - rest[:, :-1, 0]
    return float(np.median(apart)) if apart.size else 0.0


@lru_cache(maxsize=4)
def _rectifier(calibration: str, finger: Finger) -> Rectifier:
    """The rectifier from a calibration's text; raises RecordingError if it is invalid."""
    try:
        return Rectifier(Calibration.parse(calibration.encode(), "it").camera(finger))
    except ValueError as error:
        raise RecordingError(f"the recording's calibration cannot be used: {error}") from error
