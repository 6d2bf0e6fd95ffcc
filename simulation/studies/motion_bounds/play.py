"""One fault in one phase of a live insertion over real sockets: overtravel, force, and outcome."""

import contextlib
import json
import math
import shutil
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robot_client.insertion.lease import SLOW_MM
from simulation.cell.children import Child, ChildError
from simulation.cell.run import RunOptions, Start, loop
from simulation.studies.motion_bounds.faults import BOTH, Bench, Fault, Phase, ask
from simulation.studies.motion_bounds.relay import Relay
from simulation.studies.motion_bounds.wall_clock import settable

MOST_N = 25.0
AIR_MM = 1.5  # below the approach pose
END_S, SETTLE_S, STOP_S = 60.0, 0.4, 0.3
POLL_S = 0.004
REOPENED_S = 1.5  # after the service saw stamps cease
MOVED_MM = 0.05
LOGGED: dict[Phase, str] = {
    "arming": '"type": "arm"',
    "deciding": '"type": "stopped"',
    "retracting": '"motion": "retract"',
}


@dataclass(frozen=True, slots=True)
class Row:
    """``travel_mm`` after the capture of the last judged picture that showed the present; heights are the TCP's.

    ``moved_mm``: the largest motion after the arm had come to rest for good. ``injected``: whether the phase occurred.
    ``bound_mm``: what the client's lease allows.
    """

    fault: str
    phase: str
    injected: bool
    travel_mm: float
    force_n: float
    moved_mm: float
    ended: str
    inserted: bool
    hung: bool
    tracebacks: int
    bound_mm: float = SLOW_MM

    @property
    def held(self) -> bool:
        """Whether all guarantees held."""
        calm = not self.hung and not self.tracebacks and self.moved_mm <= MOVED_MM
        return calm and self.force_n <= MOST_N and self.travel_mm <= self.bound_mm


def play(fault: Fault, phase: Phase, options: RunOptions, folder: Path) -> Row:
    """Inject the fault in the first attempt; raises ChildError if the cell itself could not be started."""
    relays: list[Relay] = []

    def through(url: str) -> str:
        """Called before the client starts."""
        relays.append(Relay.to(url))
        if fault.unstamped:
            _never_stamp(folder)
        return relays[-1].url

    start = Start(options.object, 8.0, 6.0, options.seed)
    clocks = settable() if fault.sets_clock else contextlib.nullcontext()
    with clocks, loop(start, options, folder, through) as running:
        bench = Bench(running, relays[0])
        injected_ns = _inject(fault, phase, bench)
        hung = not _ended(running.client)
        time.sleep(SETTLE_S)
        trace, truth = bench.ask("trace"), bench.ask("truth")
        (folder / "trace.json").write_text(json.dumps(trace))
        logs = [child.log for child in (running.cell, running.service, running.client)]
        relays[0].close()
    entries = _entries(folder)
    since_ns = min(truth["camera_drawn_ns"]) if injected_ns and math.isinf(fault.hides_s) else injected_ns
    end: dict[str, Any] = next((e["end"] for e in reversed(entries) if "end" in e), {})
    return Row(
        fault=fault.name,
        phase=phase,
        injected=injected_ns is not None,
        travel_mm=_travel_mm(trace, entries, fault, since_ns),
        force_n=truth["course"]["max_force_n"],
        moved_mm=_moved_mm(trace, entries),
        ended="hung" if hung else str(end.get("reason") or end.get("phase") or "killed")[:160],
        inserted=bool(end.get("inserted")),
        hung=hung,
        tracebacks=sum("Traceback" in log.read_text(errors="replace") for log in logs),
        bound_mm=options.chosen().get("lease", {}).get("travel_mm", SLOW_MM),
    )


def _never_stamp(folder: Path) -> None:
    facts = json.loads((folder / "cell" / "cell.json").read_text())
    ask(facts["admin_url"], "faults", {f"camera_{finger}": {"unstamped": True} for finger in BOTH})
    time.sleep(REOPENED_S)


def _inject(fault: Fault, phase: Phase, bench: Bench) -> int | None:
    """Start of the fault on the machine's steady clock; None if the client ended before the phase came."""
    top_mm = bench.loop.facts["approach"]["z_mm"]
    descending = LOGGED.get(phase) or '"motion": "descend"'
    while bench.loop.client.code is None:
        logged = bench.loop.episode.is_file() and descending in bench.loop.episode.read_text(errors="replace")
        if logged and _reached(phase, bench, top_mm):
            begun_ns = time.monotonic_ns()
            threading.Thread(target=fault.inject, args=(bench,), daemon=True).start()
            return begun_ns
        time.sleep(POLL_S)
    return None


def _reached(phase: Phase, bench: Bench, top_mm: float) -> bool:
    if phase not in ("air", "contact"):
        return True
    glance = bench.ask("glance")
    return bool(glance["touches"] if phase == "contact" else glance["z_mm"] <= top_mm - AIR_MM)


def _ended(client: Child) -> bool:
    deadline_s = time.monotonic() + END_S
    while client.code is None and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return client.code is not None


def _entries(folder: Path) -> list[dict[str, Any]]:
    """Entries of all logs of the insertion: each regrasp begins one, named by its insertion, thus by its time."""
    logs = sorted(folder.glob("*.jsonl"), key=lambda log: (log.name != "episode.jsonl", log.name))
    entries = []
    for line in [line for log in logs for line in log.read_text(errors="replace").splitlines()]:
        with contextlib.suppress(json.JSONDecodeError):  # the client died while writing this line
            entries.append(json.loads(line))
    return entries


def _travel_mm(
    trace: list[tuple[int, float]], entries: list[dict[str, Any]], fault: Fault, injected_ns: int | None
) -> float:
    """The largest descent, over all descents, after the capture of the last picture judged in it."""
    travels = [0.0]
    for begin, begin_ns, end in _descents(entries):
        messages = [e["event"].get("message") or {} for e in entries[: _held(entries, begin)] if "event" in e]
        stamps = [m.get("frame_captured_ns") or m.get("captured_ns") for m in messages]
        captured = [stamp for m, stamp in zip(messages, stamps, strict=True) if stamp and m["type"] in _ANSWERS]
        last_ns = max(captured, default=0)
        if injected_ns is not None and last_ns > injected_ns and fault.hides_s:
            last_ns = max(injected_ns, last_ns - int(min(fault.hides_s, 1e6) * 1e9))
        until_ns = _stamp_of(entries, end)
        heights = [z for stamp, z in trace if last_ns <= stamp <= until_ns]
        started = max(begin_ns, last_ns)
        first = next((z for stamp, z in trace if stamp >= started), None)
        if heights and first is not None:
            travels.append(first - min(heights))
    return max(travels)


_ANSWERS = {"armed", "watching", "slip"}


def _held(entries: list[dict[str, Any]], begin: int) -> int:
    """Index of the first hold after ``begin``: later messages renew nothing."""
    kinds = [entry.get("command", {}).get("kind") for entry in entries[begin:]]
    return begin + kinds.index("hold") if "hold" in kinds else len(entries)


def _descents(entries: list[dict[str, Any]]) -> list[tuple[int, int, int]]:
    """For each descent its index, its begin on the steady clock, and the index of its end: a move, or the end."""
    descents: list[tuple[int, int, int]] = []
    begin, last_ns = None, 0
    for index, entry in enumerate(entries):
        last_ns = round(entry.get("event", {}).get("at_s", last_ns / 1e9) * 1e9)
        if entry.get("command", {}).get("kind") != "move":
            continue
        if begin is not None:
            descents.append((*begin, index))
        begin = (index, last_ns) if entry["command"]["motion"] == "descend" else None
    return descents if begin is None else [*descents, (*begin, len(entries))]


def _stamp_of(entries: list[dict[str, Any]], index: int) -> float:
    """Time of the entry; inf past the last one."""
    if index >= len(entries):
        return float("inf")
    stamps = [e["event"]["at_s"] for e in entries[:index] if "event" in e]
    return float(stamps[-1] * 1e9)


def _moved_mm(trace: list[tuple[int, float]], entries: list[dict[str, Any]]) -> float:
    """Motion of the arm after the last hold of the client and the allowed time of a stop."""
    holds, last_s = [], 0.0
    for entry in entries:
        last_s = entry.get("event", {}).get("at_s", last_s)
        if entry.get("command", {}).get("kind") == "hold":
            holds.append(last_s)
    rest_ns = (holds[-1] + STOP_S) * 1e9 if holds else float("inf")
    heights = [z for stamp, z in trace if stamp >= rest_ns]
    return max(heights) - min(heights) if heights else 0.0


def row_of(fault: Fault, phase: Phase, options: RunOptions, folder: Path, tries: int = 3) -> dict[str, Any]:
    """The row of one case; a run in which the phase never occurred, as on a busy machine, is repeated."""
    row = None
    for turn in range(tries):
        place = folder / f"{fault.name}-{phase}-{turn}".replace(" ", "_").replace(",", "")
        shutil.rmtree(place, ignore_errors=True)  # left by an interrupted campaign
        with contextlib.suppress(ChildError):
            row = play(fault, phase, options, place)
            if row.injected:
                break
    if row is None:
        raise ChildError(f"{fault.name} while {phase}: the cell could not be started {tries} times", None)
    return {**asdict(row), "held": row.held}
