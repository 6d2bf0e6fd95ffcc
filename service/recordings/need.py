"""What deciding a recorded insertion again takes: its networks, and memory for all of its messages at once."""

from dataclasses import dataclass
from pathlib import Path

from service.recordings.reader import RecordingError, opened
from service.recordings.writer import FINAL


@dataclass(frozen=True, slots=True)
class Need:
    """``networks``: SHA-256 of those that decided; ``bytes_n``: of all messages, pictures as they were recorded."""

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
    """The metadata of a recording, and the bytes of all its messages."""
    with opened(path) as reader:
        about = next((dict(m.metadata) for m in reader.iter_metadata() if m.name == "insertion"), {})
        summary = reader.get_summary()
        if summary is None:
            raise RecordingError("the recording has no summary")
        return about, sum(chunk.uncompressed_size for chunk in summary.chunk_indexes)
