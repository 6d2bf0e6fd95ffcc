"""JSON, CSV and logs that survive a kill."""

import csv
import fcntl
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.durable import write_durably


def write_json(path: Path, data: Any) -> None:
    write_durably(path, json.dumps(data, indent=1) + "\n")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A table with a header line, the keys of the first row; sequences are joined by semicolons."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: "; ".join(map(str, v)) if isinstance(v, list | tuple) else v for k, v in row.items()})
    write_durably(path, text.getvalue())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a log, one JSON object per line; none without the file, and without a line that a kill truncated."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


@contextmanager
def added_rows(log: Path) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Yield what adds a row to a log; a kill after the call does not lose it, and each begins its own line.

    Raises ValueError if another process adds rows to it: it would do the same work again.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"{log}: another process adds rows to it; expected its end, or another folder") from None
        if log.stat().st_size and not log.read_bytes().endswith(b"\n"):  # a kill has cut the last one
            file.write("\n")

        def add(row: Mapping[str, Any]) -> None:
            file.write(json.dumps(row) + "\n")
            file.flush()

        yield add


def read_json(path: Path, made_by: str) -> Any:
    """The data of a file; ValueError names the file and the command that makes it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path} is not there; make it with: {made_by}") from error
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); make it again with: {made_by}") from error
