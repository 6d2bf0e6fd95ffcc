"""Disk space of recordings: one limit, kept by removing the oldest, and a check for room."""

import contextlib
import json
import os
import shutil
from pathlib import Path

from service.contract.refusals import reason
from service.recordings.names import NAME
from service.recordings.writer import MAX_INSERTION_BYTES

MIN_FREE_BYTES = 200 << 20  # for a long insertion with both cameras at 90 fps


def problem_of(root: Path) -> str:
    """Why the next insertion could not be recorded into ``root``; empty if it can."""
    try:
        if not root.is_dir():
            return f"the folder {root} is missing"
        if not os.access(root, os.W_OK | os.X_OK):
            return f"the folder {root} may not be written"
        free_bytes = shutil.disk_usage(root).free
    except OSError as error:
        return f"the folder {root} cannot be read: {error.strerror}"
    return "" if free_bytes >= MIN_FREE_BYTES else f"the disk of {root} has {free_bytes >> 20} MiB left"


def largest_bytes(max_bytes: int) -> int:
    """The largest size that the file of one insertion may reach."""
    return min(MAX_INSERTION_BYTES, max_bytes // 4)


def make_room(root: Path, max_bytes: int) -> str:
    """Prune so that the next insertion fits, too; returns why that cannot be, or "".

    Many recordings take seconds: it has to be done before that insertion opens.
    """
    try:
        prune(root, max_bytes - largest_bytes(max_bytes))
    except OSError as error:
        return f"no old recording can be removed: {reason(error)}"
    return ""


def prune(root: Path, max_bytes: int) -> list[Path]:
    """Remove the oldest insertions until the rest fits into ``max_bytes``; the newest always stays. Returns them.

    Of the probes of commissionings, the newest stay that fill half of it: what a cell learns from would else be gone
    after a day of work. Those of which a full disk took nothing go, too: but the newest, which may be under way.
    Folders that are not named like a recording are neither removed nor counted. Raises OSError at the end if one of
    another user, say, has stayed: the limit is not kept then.
    """
    entries = root.iterdir() if root.is_dir() else ()
    folders = sorted(path for path in entries if NAME.fullmatch(path.name) and path.is_dir())
    sizes = [_size_bytes(folder) for folder in folders]
    removed: list[Path] = []
    errors: list[BaseException] = []
    total = sum(sizes)
    spared = _probes(folders, sizes, max_bytes // 2) if total > max_bytes else set()
    for folder, size in zip(folders[:-1], sizes[:-1], strict=True):
        if size and (total <= max_bytes or folder in spared):
            continue
        shutil.rmtree(folder, onerror=lambda _, __, raised: errors.append(raised[1]))
        removed.append(folder)
        total -= size
    for error in errors:
        if not isinstance(error, FileNotFoundError):  # that one was removed from the page meanwhile
            raise error
    return removed


def _probes(folders: list[Path], sizes: list[int], most_bytes: int) -> set[Path]:
    """The newest probes among ``folders``, oldest first, as long as they fit into ``most_bytes``."""
    probes: set[Path] = set()
    for folder, size in zip(reversed(folders), reversed(sizes), strict=True):
        if not _is_probe(folder):
            continue
        most_bytes -= size
        if most_bytes < 0:
            break
        probes.add(folder)
    return probes


def _is_probe(folder: Path) -> bool:
    try:
        summary = json.loads((folder / "summary.json").read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(summary, dict) and summary.get("purpose") == "probe"


def _size_bytes(folder: Path) -> int:
    """Size of a folder's files; what vanishes meanwhile (renamed, removed from the page), it or a file, counts as 0."""
    total = 0
    with contextlib.suppress(FileNotFoundError):
        for file in folder.iterdir():
            with contextlib.suppress(FileNotFoundError):
                total += file.stat().st_size
    return total
