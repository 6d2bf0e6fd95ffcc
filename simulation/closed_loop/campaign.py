"""Many insertions on all cores or on a cluster, logged one per line, so that a killed run can resume.

A log is valid only for the networks, the physics, the service and the client that produced it: `claim` refuses others.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reporting.files import added_rows, read_rows, write_json
from simulation.data.parallel import results
from simulation.data.progress import shown
from simulation.data.sources import sources_sha256

Row = dict[str, Any]
PLAYED_BY = "code of the simulator, the service or the client"


@dataclass(frozen=True, slots=True)
class Task:
    """One insertion to play: the folder of its networks and the fields of its `simulation.closed_loop.job.Job`.

    ``made_by``: fingerprint of code and networks, for logs that hold results of several.
    """

    models: Path
    job: Mapping[str, Any]
    made_by: str = ""

    @property
    def key(self) -> str:
        """The key by which a resumed run recognises its row."""
        return key_of({**self.job, "made_by": self.made_by})

    def made(self, row: Row) -> bool:
        """True if a logged row belongs to exactly this job, not to one of the same name under another disturbance."""
        return all(row.get(name) == value for name, value in self.job.items())


def key_of(row: Mapping[str, Any]) -> str:
    """Key of a job or of its row."""
    return "/".join(
        str(row.get(name, ""))
        for name in ("condition", "scene", "controller", "perception", "seed", "index", "made_by", "cell")
    )


def play(task: Task) -> Row:
    """In a worker: load the networks once, then play."""
    from simulation.closed_loop.job import Job
    from simulation.closed_loop.play import insert, models_of

    row = insert(Job(**task.job), models_of(task.models))
    return row | {"made_by": task.made_by} if task.made_by else row


def fingerprint(folders: Mapping[str, Path]) -> dict[str, str]:
    """SHA-256 of every deciding network, by controller, and of all the code and scenes that play an insertion."""
    hashes = {PLAYED_BY: sources_sha256("simulation.closed_loop.play")}
    for name, folder in folders.items():
        for file in sorted(folder.glob("*.step.onnx")):
            hashes[f"{name}/{file.name}"] = hashlib.sha256(file.read_bytes()).hexdigest()
    return hashes


def made_by(folders: Mapping[str, Path]) -> str:
    """A short name for code and networks, for logs that hold results of several."""
    return hashlib.sha256(json.dumps(fingerprint(folders), sort_keys=True).encode()).hexdigest()[:16]


def claim(out: Path, setup: Mapping[str, str]) -> None:
    """Claim the folder for this run; raises ValueError if it holds results of other networks or other code."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "setup.json"
    if path.exists():
        before = _setup(path)
        known = before.keys() | {PLAYED_BY}
        changed = sorted(name for name in known & setup.keys() if before.get(name) != setup[name])
        if changed:
            raise ValueError(
                f"{out} holds results of other {', '.join(changed)}; expected an empty folder (--out) or the same ones"
            )
        setup = {**before, **setup}
    write_json(path, dict(sorted(setup.items())))


def _setup(path: Path) -> dict[str, str]:
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError:
        before = None
    if not isinstance(before, dict):
        raise ValueError(  # noqa: TRY004 (of a file, not of a call)
            f"{path} does not say what the results beside it were made with; expected an empty folder"
        )
    return before


def run(tasks: Sequence[Task], log: Path, *, workers: int = 0, ray: str = "", title: str = "insertions") -> list[Row]:
    """Play what the log lacks, with progress and ETA; returns the row of each of ``tasks`` once, in their order.

    Raises ValueError if another process plays into the log.
    """
    wanted = {task.key: task for task in tasks}
    with added_rows(log) as add:
        rows = {key: row for row in read_rows(log) if (key := key_of(row)) in wanted and wanted[key].made(row)}
        missing = [task for key, task in wanted.items() if key not in rows]
        for row in shown(f"{title} (simulated)", results(play, missing, workers, ray), len(missing)):
            rows[key_of(row)] = row
            add(row)
    return [rows[key] for key in wanted]
