"""The result of a run, from the client's episode log, the cell's ground truth and the service's recording."""

import json
import math
import textwrap
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import read_rows
from simulation.closed_loop.statistics import SIGNS
from simulation.optics import attempt_picture


@dataclass(frozen=True, slots=True)
class Result:
    """One insertion in figures; errors and block motion are the simulator's ground truth."""

    object_name: str
    x_mm: float
    theta_deg: float
    seed: int
    inserted: bool
    attempts: int
    reason: str
    seconds: float
    final_x_mm: float
    final_theta_deg: float
    bottom_z_mm: float
    blocks_moved_mm: float
    blocks_tilted_deg: float
    grasp_kept: bool
    max_force_n: float
    turned_in_hand_deg: float
    frozen_ms: tuple[float, ...]
    rest_ms: tuple[float, ...]
    overtravel_mm: tuple[float, ...]
    cores: tuple[float, float] = (math.nan, math.nan)  # mean CPU of cell and service during the insertion

    def as_json(self) -> str:
        return json.dumps(asdict(self), indent=1)


def _slips(events: list[dict[str, Any]]) -> list[int]:
    """Capture stamps (steady clock, ns) of the frames that showed slip, one per attempt."""
    first: dict[tuple[str, int], int] = {}
    for entry in events:
        message = entry.get("event", {}).get("message", {})
        if message.get("type") == "slip":
            first.setdefault((message.get("insertion_id", ""), int(message["attempt"])), int(message["captured_ns"]))
    return list(first.values())


def collect(
    truth: dict[str, Any], log: Path, *, seconds: float, cores: tuple[float, float] = (math.nan, math.nan), **start: Any
) -> Result:
    """Combine episode log and ground truth; ``start`` gives ``object_name``, ``x_mm``, ``theta_deg`` and ``seed``."""
    logs = [log, *sorted(log.parent.glob(f"{log.stem}-*{log.suffix}"), key=lambda path: path.stat().st_mtime)]
    events = [entry for one in logs for entry in read_rows(one)]  # one log per grasp of the object
    ends = [entry["end"] for entry in events if "end" in entry] or [{}]
    end, refused_n = ends[-1], len(ends) - 1  # in each earlier one the last attempt was refused
    body, course = truth.get("object", {}), truth["course"]
    frozen, rest, over = [], [], []
    for slip_ns in _slips(events):
        stop = next((stop for stop in truth["stops"] if stop["rest_ns"] > slip_ns), None)
        if stop is not None:
            frozen.append(max(0.0, (stop["frozen_ns"] - slip_ns) / 1e6))
            rest.append((stop["rest_ns"] - slip_ns) / 1e6)
            over.append(stop["overtravel_mm"])
    claimed, shortfalls = bool(end.get("inserted", False)), "; ".join(body.get("shortfalls", []))
    contradiction = f"the client claims an insertion, but {shortfalls} (truth)" if claimed and shortfalls else ""
    turned = np.degrees(np.linalg.norm(body.get("in_hand", [0.0] * 6)[3:]))
    return Result(
        **start,
        inserted=claimed and bool(body.get("inserted", False)),
        attempts=sum(int(one.get("attempts", 0)) for one in ends) - refused_n,
        reason=contradiction or str(end.get("reason") or ""),
        seconds=seconds,
        final_x_mm=float(body.get("x_mm", math.nan)),
        final_theta_deg=float(body.get("theta_deg", math.nan)),
        bottom_z_mm=float(body.get("bottom_z_mm", math.nan)),
        blocks_moved_mm=float(course["max_block_shift_mm"]),
        blocks_tilted_deg=float(course["max_block_tilt_deg"]),
        grasp_kept=bool(truth["gripper"]["held"]) and not body.get("grasp_lost", False),
        max_force_n=float(course["max_force_n"]),
        turned_in_hand_deg=float(turned),
        frozen_ms=tuple(frozen),
        rest_ms=tuple(rest),
        overtravel_mm=tuple(over),
        cores=cores,
    )


def screen(
    result: Result, recording: Path | None, drawn: Path | None, folder: Path, film: Path | None = None
) -> list[str]:
    word = "INSERTED" if result.inserted else "NOT INSERTED"
    count = f"{result.attempts} attempt{'' if result.attempts == 1 else 's'}"
    lines = [
        (
            f"{word} after {count}, {result.seconds:.1f} s   (simulated cell, {result.object_name},"
            f" start x {result.x_mm:+.2f} mm, yaw {result.theta_deg:+.2f} deg, seed {result.seed})"
        )
    ]
    if result.reason and not result.inserted:
        lines.append(f"  reason       {result.reason}")
    lines += [
        (
            f"  final error  x {result.final_x_mm:+.2f} mm, yaw {result.final_theta_deg:+.2f} deg (truth),"
            f" bottom {-result.bottom_z_mm:.1f} mm below the block tops"
        ),
        f"  blocks       moved at most {result.blocks_moved_mm:.2f} mm, tilted {result.blocks_tilted_deg:.2f} deg",
        (
            f"  grasp        {'kept' if result.grasp_kept else 'LOST'}, object turned"
            f" {result.turned_in_hand_deg:.1f} deg in the hand, largest force {result.max_force_n:.1f} N"
        ),
    ]
    if result.rest_ms:
        lines.append(
            f"  slip stop    target frozen {np.median(result.frozen_ms):.0f} ms after the frame"
            f" (worst {max(result.frozen_ms):.0f}), arm at rest {np.median(result.rest_ms):.0f} ms"
            f" (worst {max(result.rest_ms):.0f}), overtravel {np.median(result.overtravel_mm):.2f} mm"
        )
    if not np.isnan(result.cores).any():
        lines.append(f"  CPU          cell {result.cores[0]:.2f} cores, service {result.cores[1]:.2f} cores")
    lines.append(f"  recording    {recording or 'none'}")
    lines.append(f"  picture      {drawn or 'none: no attempt was blocked'}")
    lines.append(f"  film         {film or 'none'}")
    lines.append(f"  logs         {folder}")
    return lines


def telling_recording(folder: Path) -> Path | None:
    """The newest recording that holds an attempt: after a regrasp the object is often inserted without one."""
    entries = sorted(path for path in folder.glob("*") if path.is_dir())
    return max(entries, key=lambda path: (any(path.glob("attempt_*.npz")), path), default=None)


def _direction(probabilities: dict[str, float]) -> list[list[float]]:
    """Probabilities of the error classes by yaw (anticlockwise first) and x (left first)."""
    shares = {SIGNS[name]: share for name, share in probabilities.items()}
    return [[shares.get((x, yaw), 0.0) for x in (-1, 0, 1)] for yaw in (1, 0, -1)]


def draw_last_attempt(recording: Path, path: Path, result: Result) -> Path | None:
    """Picture of the last attempt with a decision; None if there was none."""
    attempts = sorted(recording.glob("attempt_*.npz"))
    if not attempts:
        return None
    with np.load(attempts[-1], allow_pickle=False) as data:
        answer = json.loads(str(data["decision"]))
        frames, valid = data["frames"], data["valid"]
        motion = data["rest_px"], data["displacement_px"]
    number = int(attempts[-1].stem.split("_")[1])
    decision: attempt_picture.Decision = {
        "title": f"{result.object_name}: attempt {number} of {result.attempts}, simulated",
        "notes": textwrap.wrap(f"{answer.get('reason', '')} {answer.get('detail', '')}", 40),
    }
    estimate = answer.get("estimate")
    if estimate is not None:
        decision["estimate"] = (estimate["dx_mm"], estimate["dtheta_deg"])
        decision["correction"] = (answer["dx_mm"], answer["dtheta_deg"])
        decision["direction"] = _direction(answer["class_probabilities"])
        if estimate.get("interval_x_mm") and estimate.get("interval_theta_deg"):
            decision["interval"] = (tuple(estimate["interval_x_mm"]), tuple(estimate["interval_theta_deg"]))
    return attempt_picture.save(path, frames, decision, motion, valid)
