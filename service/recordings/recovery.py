"""Recovery after a crash: recordings without an end are closed, so that every tool opens them.

A killed service leaves ``insertion.mcap.part``, complete except for the last second. The recorder locks that file while
it writes, and the kernel releases the lock when the process dies: a part that can be locked has no writer any more.
"""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import structlog
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from service.contract import ContractError
from service.durable import locked, write_durably
from service.recordings.writer import FINAL, PART, RECOVERING, RECOVERY, TASK, UNREADABLE

LOCK = "lock"
log = structlog.get_logger()


def own(root: Path) -> IO[bytes] | None:
    """Make ``root`` and keep it for one service until the result is closed; None where nothing can be written.

    Two services would overwrite each other's alarms and charts, remove each other's recordings, and take the object in
    the other's hand for their own. Raises ContractError if another service has it.
    """
    root.mkdir(parents=True, exist_ok=True)
    try:
        return locked(root, LOCK)
    except BlockingIOError:
        why = f"another service keeps its recordings in {root}; give each its own --recordings"
        raise ContractError(why) from None
    except OSError:  # no insertion can be recorded there either, and /readyz says so
        return None


def recover(root: Path) -> list[Path]:
    """Close every recording under ``root`` that lost its writer; returns the completed files.

    A file that cannot be closed is left unchanged: an old recording must not keep the service from starting. A part
    without any insertion is renamed to ``insertion.mcap.unreadable`` and left for people.
    """
    return [part.with_name(FINAL) for part in sorted(root.glob(f"*/{PART}")) if _closed(part)]


def is_being_written(folder: Path) -> bool:
    """Whether a live recorder writes into this folder."""
    try:
        with (folder / PART).open("r+b") as stream:  # an NFS share locks only what is open for writing
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _closed(part: Path) -> bool:
    """Whether the part was completed; if that is impossible now (a full disk), it is left for the next start."""
    try:
        with part.open("r+b") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return _close(part, stream)
    except BlockingIOError:  # it has its writer
        return False
    except Exception as error:
        with contextlib.suppress(OSError):  # of a disk that is read-only now
            part.with_name(RECOVERING).unlink()
        log.warning("recording not recovered", path=str(part), error=repr(error))
        return False


def _close(part: Path, stream: IO[bytes]) -> bool:
    whole = part.with_name(RECOVERING)
    with whole.open("wb") as out:
        facts = _copy(stream, out)
        out.flush()
        os.fsync(out.fileno())
    if facts is None:
        whole.unlink()
        part.rename(part.with_name(UNREADABLE))
        log.warning("recording unreadable", path=str(part.with_name(UNREADABLE)))
        return False
    summary = part.with_name("summary.json")
    if not summary.is_file():
        write_durably(summary, json.dumps(facts, indent=1))
    whole.rename(part.with_name(FINAL))
    part.unlink()
    log.warning("recording recovered", path=str(part.with_name(FINAL)), **facts)
    return True


def _copy(stream: IO[bytes], out: IO[bytes]) -> dict[str, object] | None:
    """Copy the readable part into a complete file; returns its summary, None if it never was a recording."""
    writer = Writer(out, chunk_size=1 << 20, compression=CompressionType.LZ4)
    writer.start(profile="", library="tactile-insertion")
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, tuple[int, str]] = {}
    facts: dict[str, object] | None = None
    attempts, task = 0, dict[str, object]()
    for record in _records(stream):
        match record:
            case Schema():
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            case Channel():
                number = writer.register_channel(record.topic, record.message_encoding, schemas[record.schema_id])
                channels[record.id] = number, record.topic
            case Attachment():
                about = record.create_time, record.log_time, record.name, record.media_type
                writer.add_attachment(*about, record.data)
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
                if record.name == "insertion":
                    facts = {"insertion_id": record.metadata["insertion_id"], "left_out_n": 0}
            case Message():
                number, topic = channels[record.channel_id]
                writer.add_message(number, record.log_time, record.data, record.publish_time, record.sequence)
                message = json.loads(record.data)["message"] if topic == "/messages" else {}
                number = message.get("attempt", 0)
                attempts = max(attempts, number if isinstance(number, int) else 0)
                if message.get("type") == "episode":
                    task |= {key: message.get(key) for key in TASK}
                if message.get("continues"):
                    task["continues"] = message["continues"]
    writer.add_metadata(RECOVERY, {"reason": "the service ended without closing this recording"})
    writer.finish()
    return (
        None if facts is None else facts | task | {"outcome": "interrupted", "cause": "service", "attempts": attempts}
    )


def _records(stream: IO[bytes]) -> Iterator[object]:
    """Every record up to where the file breaks off."""
    with contextlib.suppress(McapError, EOFError, ValueError, KeyError, IndexError, RuntimeError):
        yield from StreamReader(stream).records
