"""What deciding a recorded insertion again takes: its networks, and memory for all of its pictures at once."""

from dataclasses import dataclass
from pathlib import Path

from mcap.reader import McapReader

from service.contract import FINGERS
from service.recordings.reader import RecordingError, opened, pixels_of
from service.recordings.writer import FINAL, IMAGE

TOPICS = {f"/{finger}/{name}" for finger in FINGERS for name in IMAGE.values()}


@dataclass(frozen=True, slots=True)
class Need:
    """``networks``: SHA-256 of those that decided; ``bytes_n``: of the file, and of all its pictures, decoded."""

    networks: frozenset[str]
    bytes_n: int


def needed(path: Path) -> Need:
    """The need of a recording and of those whose object it continues with; RecordingError if one cannot be read."""
    about, bytes_n = _read(path)
    networks = frozenset(part.rpartition(":")[2] for part in about.get("models", "").split())
    earlier = path.parent.name
    while before := about.get("continues"):
        folders = [f for f in path.parents[1].iterdir() if f.name.partition("_")[2] == before and f.name < earlier]
        if not folders:
            break  # the replay names what is missing
        earlier = max(folder.name for folder in folders)
        about, more_n = _read(path.parents[1] / earlier / FINAL)
        bytes_n += more_n
    return Need(networks, bytes_n)


def _read(path: Path) -> tuple[dict[str, str], int]:
    """The metadata of a recording, and the bytes that it takes."""
    with opened(path) as reader:
        about = next((dict(m.metadata) for m in reader.iter_metadata() if m.name == "insertion"), {})
        return about, path.stat().st_size + _pictures_bytes(reader)


def _pictures_bytes(reader: McapReader) -> int:
    """Of all pictures, each as large as the first one of its topic."""
    summary, bytes_n = reader.get_summary(), 0
    if summary is None or summary.statistics is None:
        raise RecordingError("the recording has no summary")
    for number, channel in summary.channels.items():
        count = summary.statistics.channel_message_counts.get(number, 0)
        if channel.topic in TOPICS and count:
            _, _, first = next(reader.iter_messages([channel.topic]))
            bytes_n += count * pixels_of(channel.topic, first.data).nbytes
    return bytes_n
