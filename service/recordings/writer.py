"""Recordings: one folder an insertion, an MCAP file that Foxglove and Rerun open, and a small file an attempt.

``RECORDINGS/<UTC stamp>_<insertion id>/``

- ``insertion.mcap`` (``insertion.mcap.part`` while it is written; a crash loses at most the last half second, and
  :func:`service.recordings.recovery.recover` closes such a file at the next start). Topics, each with one schema:
  ``/left/image`` and ``/right/image`` (foxglove.CompressedImage, the camera's own JPEG) or, of a camera that sends
  pixels, ``/left/image_raw`` and ``/right/image_raw`` (foxglove.RawImage), ``/left/markers`` and ``/right/markers``
  (tactile_insertion.Markers: every judged frame), ``/robot`` (arm and gripper, 50 times a second, from the client),
  ``/messages`` (``from`` client or service, ``message``), ``/calls`` (the calls of the session in order, which make a
  replay exact to the bit), ``/beside`` (what versions beside the active one would have answered). Metadata:
  ``insertion`` (id, versions, models, controller, calibration, clock offset) and, once it has ended, ``outcome``.
  Attachments: ``configuration.json`` (the service's settings without its tokens), ``calibration.toml`` where cameras
  are rectified, and ``NAME.card.json`` of each network. Log times are wall-clock nanoseconds: capture stamp +
  ``wall_minus_monotonic_ns`` of the metadata.
- ``attempt_01.npz``, ``attempt_02.npz``, ... for each blocked attempt, read with ``numpy.load``:

  ===================  ==========================================================================================
  ``frames``           uint8 [n, 2, H, W, 3] BGR, rectified; the n <= 8 pairs of the decision, left finger first
  ``reference``        uint8 [2, H, W, 3] BGR, rectified; what the networks subtract
  ``frame_seq``        int64 [n], pair numbers; ``captured_ns`` int64 [n], monotonic
  ``rest_px``          float32 [2, rows, cols, 2] marker positions at rest (u, v) in the rectified image
  ``displacement_px``  float32 [2, rows, cols, 2] marker displacement in the last of the pairs
  ``valid``            bool [2, rows, cols]; ``held_px`` where markers were before the descent, NaN if not found
  ``steps``            float32 [k, 2, rows, cols, 3] of (du_mm, dv_mm, 1 if seen), a step of depth each, and
                       ``conditions`` float32 [6] (`model_card.CONDITIONS`): what networks that read depth were shown
  ``decision``         0-d string array: JSON of the ``correction`` or ``no_decision`` message; "{}" if there was none
  ===================  ==========================================================================================

- ``summary.json``: insertion id, outcome, cause, attempts, object, start, seconds, decisions, frames left out.
"""

import contextlib
import fcntl
import json
import os
import queue
import threading
import time
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from service.cameras.capture import CameraFrame
from service.contract import TactileFrame, wire
from service.contract.refusals import reason
from service.durable import replacing, write_durably
from service.perception.observation import Observation
from service.recordings.messages import image_message, markers_message
from service.recordings.names import name_after
from service.recordings.schemas import CompressedImage, Markers, RawImage, descriptor_set, encode, json_schema

FLUSH_S = 0.2  # most recent time that a kill may lose, besides a chunk in progress
MAX_WAITING_BYTES = 64 << 20  # of frames and markers; about 10 s of JPEG at 2 x 60 fps
MAX_INSERTION_BYTES = 2 << 30
PART = "insertion.mcap.part"
FINAL = "insertion.mcap"
RECOVERING = "insertion.mcap.recovering"
UNREADABLE = "insertion.mcap.unreadable"
IMAGE = {CompressedImage: "image", RawImage: "image_raw"}  # a topic has one schema, whatever the camera sends
MEDIA = {"json": "application/json", "toml": "application/toml"}  # of attachments
CONFIGURATION = "configuration.json"  # name of the attachment with the service's settings
TASK = ("purpose", "simulated", "object", "start", "approach", "starts", "versions")  # of `episode`, for the summary
OUTCOME = "outcome"  # name of the metadata in an ended recording
RECOVERY = "recovery"  # name of the metadata in a recovered recording


class _Mcap:
    """The MCAP file: registers channels on first use; only the recorder's thread touches it."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._writer = Writer(stream, chunk_size=1 << 20, compression=CompressionType.LZ4)
        self._writer.start(profile="", library="tactile-insertion")
        self._channels: dict[str, int] = {}

    def protobuf(self, topic: str, kind: Any, values: Mapping[str, Any], log_ns: int, seq: int) -> None:
        if topic not in self._channels:
            schema = self._writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", descriptor_set(kind))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema)
        self._writer.add_message(self._channels[topic], log_ns, encode(kind, values, log_ns), log_ns, seq)

    def json(self, topic: str, value: Mapping[str, Any], log_ns: int) -> None:
        if topic not in self._channels:
            name, described = json_schema(topic)
            schema = self._writer.register_schema(name, "jsonschema", described)
            self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        self._writer.add_message(self._channels[topic], log_ns, json.dumps(value).encode(), log_ns, 0)

    def attach(self, name: str, content: bytes, log_ns: int) -> None:
        self._writer.add_attachment(log_ns, log_ns, name, MEDIA[name.rsplit(".", 1)[-1]], content)

    def metadata(self, name: str, value: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(value))

    def flush(self) -> None:
        self._writer.flush()
        self._stream.flush()

    def close(self) -> None:
        self._writer.finish()
        self._stream.flush()


@dataclass(slots=True)
class Recorder:
    """Writes one insertion in its own thread; every method returns at once.

    If the disk is too slow, or the file reaches ``largest_bytes``, frames and observations are left out, counted and
    named in ``problem``; messages and calls never are. ``kept``: closed, and on disk under its final name.
    """

    root: Path
    insertion_id: str
    metadata: Mapping[str, str]
    largest_bytes: int = MAX_INSERTION_BYTES
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    left_out_n: int = 0
    folder: Path = field(init=False)
    _queue: queue.SimpleQueue[Callable[[], object] | None] = field(init=False, default_factory=queue.SimpleQueue)
    _thread: threading.Thread = field(init=False)
    _mcap: _Mcap = field(init=False)
    _stream: IO[bytes] = field(init=False)
    _offset_ns: int = field(init=False)
    error: str = ""
    kept: bool = False
    _stuck: bool = False
    _full: bool = False
    _waiting_bytes: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        """Create the folder and start writing; raises OSError if the folder cannot be written."""
        started = datetime.now(UTC)
        self.folder = self.root / name_after(self.root, self.insertion_id, started)
        self.folder.mkdir(parents=True)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._stream = (self.folder / PART).open("wb")
        fcntl.flock(self._stream, fcntl.LOCK_EX)  # shows a recovery that the writer is alive; a list holds it briefly
        self._mcap = _Mcap(self._stream)
        facts = {"insertion_id": self.insertion_id, "started": started.isoformat()}
        self._mcap.metadata(
            "insertion", facts | dict(self.metadata) | {"wall_minus_monotonic_ns": str(self._offset_ns)}
        )
        for name, content in self.attachments.items():
            self._mcap.attach(name, content, time.time_ns())
        self._mcap.flush()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """Path of the finished recording."""
        return self.folder / FINAL

    @property
    def problem(self) -> str:
        """What the recording lacks, and why; empty as long as it has everything."""
        if self.error or not self.left_out_n:
            return self.error
        limit = f"the file reached its limit of {self.largest_bytes / 1e6:.0f} MB"
        why = limit if self._full else "the disk is too slow"
        return f"{self.left_out_n} frames and observations were left out: {why}"

    def frame(self, frame: CameraFrame) -> None:
        kind, values = image_message(frame)
        topic = f"/{frame.frame.finger}/{IMAGE[kind]}"
        self._put_bulk(topic, kind, values, frame.frame)

    def observation(self, observation: Observation) -> None:
        self._put_bulk(f"/{observation.finger}/markers", Markers, markers_message(observation), observation)

    def message(self, sender: str, message: Mapping[str, Any], now_ns: int) -> None:
        """Record a wire message; ``sender`` is client or service."""
        value = {"from": sender, "message": message}
        self._queue.put(lambda: self._mcap.json("/messages", value, now_ns + self._offset_ns))

    def call(self, value: Mapping[str, Any], now_ns: int) -> None:
        """Record one call of the session (see :mod:`service.tools.redecide`)."""
        self._queue.put(lambda: self._mcap.json("/calls", dict(value) | {"now_ns": now_ns}, now_ns + self._offset_ns))

    def robot(self, sample: wire.RobotSample, at_ns: int) -> None:
        """Record the pose of arm and gripper at ``at_ns`` of this machine's monotonic clock."""
        log_ns = max(0, at_ns + self._offset_ns)  # no file holds less: a client's clock may fall by decades
        self._queue.put(lambda: self._mcap.json("/robot", sample.model_dump(mode="json"), log_ns))

    def work_out(self, topic: str, work: Callable[[], Mapping[str, Any]], now_ns: int) -> None:
        """Record a value that the recorder's thread, which has the time, still has to compute."""
        self._queue.put(lambda: self._mcap.json(topic, work(), now_ns + self._offset_ns))

    def attempt(self, number: int, gather: Callable[[], Mapping[str, NDArray[Any]]]) -> None:
        """Write ``attempt_XX.npz``; its 5 MB or so are gathered in the recorder's thread; no arrays, no file."""
        path = self.folder / f"attempt_{number:02d}.npz"

        def save() -> None:
            if arrays := gather():
                save_arrays(path, arrays)

        self._queue.put(save)

    def close(self, summary: Mapping[str, Any]) -> Path:
        """Write pending data, close the file, give it its final name; blocks until done and returns the path."""
        if self._thread.is_alive():
            self._queue.put(lambda: self._write_summary(summary))
            self._queue.put(None)
            self._thread.join()
        return self.path

    def _put_bulk(self, topic: str, kind: Any, values: dict[str, Any], of: TactileFrame | Observation) -> None:
        """Queue data that may be dropped, keeping only the bytes to be written."""
        size = sum(len(value) if isinstance(value, bytes) else getattr(value, "nbytes", 0) for value in values.values())
        with self._lock:
            room = self._waiting_bytes + size <= MAX_WAITING_BYTES and not self._stuck
            self._waiting_bytes += size if room else 0
            self.left_out_n += not room
        if room:
            log_ns, seq = of.captured_ns + self._offset_ns, of.seq
            self._queue.put(lambda: self._write_bulk(topic, kind, values, log_ns, seq, size))

    def _run(self) -> None:
        flushed = time.monotonic()
        while True:
            try:
                work = self._queue.get(timeout=FLUSH_S)
            except queue.Empty:
                work = tuple  # nothing to write; the flush follows
            if work is None:
                break
            try:
                work()
                if time.monotonic() - flushed > FLUSH_S:
                    self._mcap.flush()
                    flushed = time.monotonic()
            except Exception as error:
                self._stuck = self._stuck or isinstance(error, OSError)  # a value that cannot be stored ends nothing
                self.error = self.error or reason(error)
        self._finish()

    def _finish(self) -> None:
        """Give the file its final name; an incomplete one is left for a recovery."""
        try:
            self._mcap.close()
            put_on_disk(self.folder)
            if not self._stuck:
                (self.folder / PART).rename(self.path)
                self.kept = True
        except OSError as error:
            self.error = self.error or reason(error)
        finally:
            with contextlib.suppress(OSError):  # a last try to write the rest
                self._stream.close()

    def _write_bulk(self, topic: str, kind: Any, values: dict[str, Any], log_ns: int, seq: int, size: int) -> None:
        with self._lock:
            self._waiting_bytes -= size
        if self._stream.tell() > self.largest_bytes:
            self.left_out_n, self._full = self.left_out_n + 1, True
            return
        self._mcap.protobuf(topic, kind, values, log_ns, seq)

    def _write_summary(self, summary: Mapping[str, Any]) -> None:
        facts = {"insertion_id": self.insertion_id, "left_out_n": self.left_out_n} | dict(summary)
        facts |= {"problem": self.problem} if self.problem else {}
        if not self._stuck:
            self._mcap.metadata(OUTCOME, {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()})
        write_durably(self.folder / "summary.json", json.dumps(facts, indent=1))


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """An ``.npz`` with light compression (numpy's own level takes ten times as long for a few per cent).

    A power cut costs the attempt under way, and none before it.
    """
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)


def put_on_disk(folder: Path) -> None:
    """Wait until a power cut would not shorten any file of a folder."""
    for path in filter(Path.is_file, folder.iterdir()):
        with path.open("rb") as file:
            os.fsync(file.fileno())
