"""`python -m simulation slip-report`: how well slip is seen, and what seeing costs, on trials whose truth is known.

Writes JSON, a picture and a table. A trial is right if slip is announced from the moment a tenth of the nodes slip to
three frames after a quarter does (slip trials), or never (others). Earlier is a false alarm, later or never a miss.
The detector's stall rule presumes a moving arm, so alarms count while the arm moves; "arm also standing still" is
judged without that rule over the whole of every trial. With `--real` recordings of a real sensor are judged too.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS
from service.perception.markers.field import MarkerField, field_from_gel
from service.perception.markers.tracker import MarkerTracker, TrackerSettings
from service.perception.slip.detector import SlipDetector, SlipSettings
from service.perception.slip.onset import OnsetDetector
from simulation.optics.renderer import Appearance, Renderer
from simulation.studies.slip.baselines import rule_2019
from simulation.studies.slip.cost import cost_ms
from simulation.studies.slip.trials import NO_SLIP_SHARE, SlipTrial, draw_trials

LATE_N = 3
STANDING = "images, arm also standing still"
Image = NDArray[np.uint8]


class Tracker(Protocol):
    """What the report compares."""

    def update(self, image: Image, captured_ns: int) -> MarkerField:
        """One rectified frame in, the marker field out."""


def wilson(hits: int, count: int, z: float = 1.96) -> tuple[float, float, float]:
    """Share and its 95 % Wilson interval; (nan, 0, 1) of nothing."""
    if count == 0:
        return math.nan, 0.0, 1.0
    p = hits / count
    centre = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return p, max(0.0, centre - half), min(1.0, centre + half)


@dataclass(slots=True)
class Tally:
    """Verdicts of one way of seeing, over trials."""

    right: int = 0
    missed: int = 0
    false: int = 0
    trials: int = 0
    delays: list[int] = field(default_factory=list)
    onsets: list[int] = field(default_factory=list)
    frame_ms: list[float] = field(default_factory=list)

    def judge(self, trial: SlipTrial, alarm: int | None, *, standing: bool = False) -> None:
        """Count one trial; trials between slip and none are left out, and so are alarms of a standing arm."""
        if trial.label == "between":
            return
        if alarm is not None and alarm >= trial.still_frame and not standing:
            alarm = None
        self.trials += 1
        begun = np.flatnonzero(trial.share >= NO_SLIP_SHARE)
        if alarm is not None and (begun.size == 0 or alarm < begun[0]):
            self.false += 1
        elif trial.slip_frame >= 0 and (alarm is None or alarm > trial.slip_frame + LATE_N):
            self.missed += 1
        else:
            self.right += 1
        if trial.slip_frame >= 0 and alarm is not None:
            self.delays.append(alarm - trial.slip_frame)

    def summary(self) -> dict[str, Any]:
        """Plain numbers, shares with their Wilson intervals."""
        delays = np.array(self.delays or [0])
        return {
            "trials": self.trials,
            "accuracy": wilson(self.right, self.trials),
            "misses": wilson(self.missed, self.trials),
            "false": wilson(self.false, self.trials),
            "delay_frames": {
                "median": float(np.median(delays)),
                "p5": float(np.percentile(delays, 5)),
                "p95": float(np.percentile(delays, 95)),
                "within_one": float((np.abs(delays) <= 1).mean()),
            },
            "onset_error_frames": {"exact": float(np.mean(np.array(self.onsets or [0]) == 0)), "n": len(self.onsets)},
            "cpu_ms_per_frame": float(np.median(self.frame_ms)) if self.frame_ms else None,
        }


def pictures(trial: SlipTrial) -> list[list[Image]]:
    """Rectified frames of a trial, [finger][frame]."""
    drawn = []
    for finger, name in enumerate(FINGERS):
        renderer = Renderer(Appearance.draw(trial.scene, name, trial.seed))
        drawn.append([renderer.rectified(gel[finger], trial.seed + k) for k, gel in enumerate(trial.gel)])
    return drawn


def see(
    trial: SlipTrial, images: list[list[Image]], make: Callable[[], Tracker], tally: Tally
) -> list[list[MarkerField]]:
    """Marker fields of both fingers by one tracker; the CPU time of each frame after the first goes to the tally."""
    fields = []
    stamp_ns = round(1e9 / trial.scene.fps)
    for frames in images:
        tracker, seen = make(), []
        for k, image in enumerate(frames):
            begun = time.process_time()
            seen.append(tracker.update(image, k * stamp_ns))
            if k:
                tally.frame_ms.append(1e3 * (time.process_time() - begun))
        fields.append(seen)
    return fields


def true_fields(trial: SlipTrial) -> list[list[MarkerField]]:
    """The fields a perfect tracker would give."""
    sensor, step = trial.scene.sensor, round(1e9 / trial.scene.fps)
    return [[field_from_gel(gel[finger], k * step, sensor) for k, gel in enumerate(trial.gel)] for finger in range(2)]


def alarm_of(fields: Iterable[Sequence[MarkerField]], settings: SlipSettings | None = None) -> int | None:
    """First frame at which either finger announces slip."""
    firsts = []
    for sequence in fields:
        detector = SlipDetector(settings)
        detector.rearm(sequence[0])
        firsts += [k for k, seen in enumerate(sequence) if k and detector.update(seen).slip][:1]
    return min(firsts, default=None)


def alarm_2019(fields: Iterable[Sequence[MarkerField]]) -> int | None:
    """The same by the rule of 2019."""
    firsts = []
    for sequence in fields:
        firsts += [k for k, seen in enumerate(sequence) if seen.usable and rule_2019(seen, sequence[0])][:1]
    return min(firsts, default=None)


def onset_of(fields: Iterable[Sequence[MarkerField]]) -> int | None:
    """First frame at which either finger shows motion."""
    found = []
    for sequence in fields:
        detector = OnsetDetector()
        detector.rearm(sequence[0])
        found += [onset.index + 1 for onset in map(detector.update, sequence[1:]) if onset][:1]
    return min(found, default=None)


def evaluate(count: int, seed: int, fps: int, watch: Callable[[], None]) -> dict[str, Any]:
    """``count`` trials by the standard tracker, on true fields and by the rule of 2019; what the slip path costs."""
    tallies = {name: Tally() for name in ("images", "held out, images", STANDING, "true fields", "2019 rule")}
    objects: dict[str, Tally] = {}
    for trial in draw_trials(count, seed, fps):
        images = pictures(trial)
        fields = see(trial, images, MarkerTracker, tallies["images"])
        alarm, onset = alarm_of(fields), onset_of(fields)
        for tally in (tallies["images"], objects.setdefault(trial.name, Tally())):
            tally.judge(trial, alarm)
            if trial.onset_frame >= 0 and onset is not None:
                tally.onsets.append(onset - trial.onset_frame)
        if trial.held_out:
            tallies["held out, images"].judge(trial, alarm)
        without_stall = alarm_of(fields, SlipSettings(stall_pitch=math.inf))
        tallies[STANDING].judge(trial, without_stall, standing=True)
        tallies["true fields"].judge(trial, alarm_of(true_fields(trial)))
        tallies["2019 rule"].judge(trial, alarm_2019(fields))
        watch()
    return {
        "path_ms": cost_ms(4, seed, fps),
        "settings": asdict(TrackerSettings()) | {"seed": seed, "fps": fps, "late_frames": LATE_N},
        "slip": {name: tally.summary() for name, tally in tallies.items()},
        "objects": {name: tally.summary() for name, tally in sorted(objects.items())},
    }


def main(arguments: list[str]) -> int:
    """Evaluate, then write the JSON, the picture and the table."""
    parser = argparse.ArgumentParser(prog="tactile-insertion slip-report", description=__doc__)
    parser.add_argument("--trials", type=int, default=320, help="trials in all (%(default)s)")
    parser.add_argument("--tradeoff", type=int, default=80, help="trials seen by every tracker (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fps", type=int, choices=(30, 60, 90), default=30)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder for slip_report.* (%(default)s)")
    parser.add_argument("--real", type=Path, help="folder of the real recordings; their last result stays without it")
    parser.add_argument("--keep-trials", action="store_true", help="run no trials, keep those of OUT/slip_report.json")
    given = parser.parse_args(arguments)
    if given.trials < 1 or given.tradeoff < 1:
        raise ValueError(f"--trials {given.trials} --tradeoff {given.tradeoff}: expected at least 1")
    from rich.progress import Progress

    from simulation.studies.slip import real as slip_real
    from simulation.studies.slip import tracker_costs
    from simulation.studies.slip.report import write

    path = given.out / "slip_report.json"
    before: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    if given.keep_trials and not before:
        raise ValueError(f"--keep-trials: there is no {path} to keep them from")
    result, real = before, before.get("real")
    with Progress() as progress:
        if given.real is not None:
            folders = len(list((given.real / "gelsight_mini_slip").glob("*_*")))
            clips = progress.add_task("recordings", total=folders)
            real = slip_real.evaluate(given.real, lambda: progress.advance(clips))
        if not given.keep_trials:
            task = progress.add_task("trials", total=given.trials)
            result = evaluate(given.trials, given.seed, given.fps, lambda: progress.advance(task))
            compared = progress.add_task("trackers", total=given.tradeoff)
            result["trackers"] = tracker_costs.compare(
                given.tradeoff, given.seed, given.fps, lambda: progress.advance(compared)
            )
    result["real"] = real
    given.out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(write(result, given.out))
    return 0
