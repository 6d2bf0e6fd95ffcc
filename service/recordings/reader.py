"""Reads recordings, complete ones and those that a crash cut off."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import McapReader, make_reader
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from service.cameras.capture import decode_jpeg
from service.contract import ContractError, Finger, TactileFrame
from service.recordings.schemas import CompressedImage, RawImage
from service.recordings.writer import CONFIGURATION, IMAGE, OUTCOME, RECOVERY


class RecordingError(ContractError):
    """A file is not a recording of an insertion; the text names it."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One message of a recording: topic, wall-clock log time, sequence number, bytes."""

    topic: str
    log_ns: int
    seq: int
    data: bytes

    def json(self) -> dict[str, Any]:
        """The message as a JSON object; raises RecordingError if it is none."""
        try:
            content = json.loads(self.data)
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise RecordingError(f"message {self.seq} of {self.topic} is no JSON object: not a recording of ours")
        return content


@contextlib.contextmanager
def opened(path: Path) -> Iterator[McapReader]:
    """The reader of a finished recording; one that is damaged raises RecordingError, whatever its library raises."""
    try:
        with path.open("rb") as stream:
            yield make_reader(stream, validate_crcs=True)
    except ContractError:
        raise
    except Exception as error:
        raise RecordingError(f"the recording cannot be read: {str(error) or type(error).__name__}") from error


class Recording:
    """A recorded insertion; ``damage`` is why the file cannot be read to its end (the part read is still valid).

    ``recovered`` is True if it once did and was closed at the next start. ``settings``: JSON of the service's.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, str] = {}
        self.outcome: dict[str, str] = {}
        self.settings = b"{}"
        self.entries: list[Entry] = []
        self.damage = ""
        self.recovered = False
        if not path.is_file():
            raise RecordingError(f"no recording at {path}")
        with path.open("rb") as stream:
            self.entries = list(self._read(stream))
        if "insertion_id" not in self.metadata:
            raise RecordingError(f"{path} is no recording of an insertion (MCAP with metadata `insertion`)")

    def _read(self, stream: Any) -> Iterator[Entry]:
        channels: dict[int, Channel] = {}
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                match record:
                    case Channel():
                        channels[record.id] = record
                    case Metadata() if record.name == "insertion":
                        self.metadata = dict(record.metadata)
                    case Attachment() if record.name == CONFIGURATION:
                        self.settings = record.data
                    case Metadata() if record.name == OUTCOME:
                        self.outcome = dict(record.metadata)
                    case Metadata() if record.name == RECOVERY:
                        self.recovered = True
                    case Message():
                        topic = channels[record.channel_id].topic
                        yield Entry(topic, record.log_time, record.sequence, record.data)
        except Exception as error:  # cut off or damaged: the library has no one error for it
            self.damage = str(error) or type(error).__name__
            if not self.metadata:
                raise RecordingError(f"{self.path} is no readable MCAP file: {self.damage}") from error

    @property
    def complete(self) -> bool:
        """Whether the file was read to its end."""
        return not self.damage

    @property
    def offset_ns(self) -> int:
        """Wall clock minus the monotonic clock of all stamps."""
        return int(self.metadata["wall_minus_monotonic_ns"])

    def of(self, topic: str) -> list[Entry]:
        """The messages of one topic, in the order they were written."""
        return [entry for entry in self.entries if entry.topic == topic]

    def frames(self, finger: Finger) -> "Frames":
        """Every recorded frame of a finger by sequence number, with its exact stamp and pixels."""
        topics = [f"/{finger}/{name}" for name in IMAGE.values()]
        return Frames(finger, {one.seq: one for topic in topics for one in self.of(topic)}, self.offset_ns)


class Frames(Mapping[int, TactileFrame]):
    """Frames by sequence number, each decoded when it is asked for; only the newest of these is kept."""

    def __init__(self, finger: Finger, entries: dict[int, Entry], offset_ns: int) -> None:
        self._finger: Finger = finger
        self._entries, self._offset_ns = entries, offset_ns
        self._newest: TactileFrame | None = None

    def __getitem__(self, seq: int) -> TactileFrame:
        entry = self._entries[seq]
        if self._newest is None or self._newest.seq != seq:
            pixels = pixels_of(entry.topic, entry.data)
            self._newest = TactileFrame(self._finger, seq, entry.log_ns - self._offset_ns, pixels)
        return self._newest

    def __iter__(self) -> Iterator[int]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


def pixels_of(topic: str, data: bytes) -> NDArray[np.uint8]:
    """The picture in a message of a finger's image topic."""
    if topic.endswith(IMAGE[CompressedImage]):
        return decode_jpeg(CompressedImage.FromString(data).data)
    image = RawImage.FromString(data)
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
