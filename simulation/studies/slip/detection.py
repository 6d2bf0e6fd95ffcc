"""Quality and cost of slip detection, on trials with known ground truth.

A slip trial is correct if slip is announced between the moment a tenth of the nodes slip and three frames after a
quarter do; any other trial is correct if slip is never announced. Earlier is a false alarm, later or never a miss. The
detector's stall rule presumes a moving arm, so alarms count while the arm moves; "arm also standing still" is evaluated
without that rule over the whole of every trial.
"""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.statistics import percentiles, wilson
from service.contract import FINGERS
from service.perception.markers.field import MarkerField, field_from_gel
from service.perception.markers.tracker import MarkerTracker, TrackerSettings
from service.perception.rectification import Rectifier
from service.perception.slip.detector import SlipDetector, SlipSettings
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.open_gel import OpenGel
from simulation.data.trial import frame_seed
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.studies.slip.trials import NO_SLIP_SHARE, SlipTrial, draw_trials

LATE_N = 3
STANDING = "images, arm also standing still"
Image = NDArray[np.uint8]


@dataclass(slots=True)
class Tally:
    """Outcomes of the trials for one kind of evidence; ``slips``: those of them in which something can be missed."""

    right: int = 0
    missed: int = 0
    false: int = 0
    trials: int = 0
    slips: int = 0
    delays: list[int] = field(default_factory=list)
    onsets: list[int] = field(default_factory=list)

    def add(self, trial: SlipTrial, alarm: int | None, *, standing: bool = False) -> None:
        """Count one trial; trials between slip and none are left out, and so are alarms at standstill."""
        if trial.label == "between":
            return
        if alarm is not None and alarm >= trial.still_frame and not standing:
            alarm = None
        self.trials += 1
        self.slips += trial.slip_frame >= 0
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
        delays = np.array(self.delays or [0])
        spread = zip(("median", "p5", "p95"), percentiles(delays, 50, 5, 95), strict=True)
        return {
            "trials": self.trials,
            "slips": self.slips,
            "accuracy": wilson(self.right, self.trials),
            "misses": wilson(self.missed, self.slips),
            "false": wilson(self.false, self.trials),
            "delay_frames": {**dict(spread), "within_one": float((np.abs(delays) <= 1).mean())},
            "onset_error_frames": {"exact": float(np.mean(np.array(self.onsets or [0]) == 0)), "n": len(self.onsets)},
        }


def pictures(trial: SlipTrial) -> list[list[Image]]:
    """Rectified frames of a trial, [finger][frame]."""
    drawn = []
    for finger, name in enumerate(FINGERS):
        renderer = Renderer(Appearance.draw(trial.scene, name, trial.seed))
        seeds = [frame_seed(trial.seed, k, finger) for k in range(len(trial.gel))]
        drawn.append([renderer.rectified(gel[finger], seed) for gel, seed in zip(trial.gel, seeds, strict=True)])
    return drawn


def track(trial: SlipTrial, images: list[list[Image]]) -> list[list[MarkerField]]:
    """Marker fields of both fingers."""
    fields = []
    stamp_ns = round(1e9 / trial.scene.fps)
    for frames in images:
        tracker = MarkerTracker()
        fields.append([tracker.update(image, k * stamp_ns) for k, image in enumerate(frames)])
    return fields


def true_fields(trial: SlipTrial) -> list[list[MarkerField]]:
    """The fields of a perfect tracker."""
    sensor, step = trial.scene.sensor, round(1e9 / trial.scene.fps)
    return [[field_from_gel(gel[finger], k * step, sensor) for k, gel in enumerate(trial.gel)] for finger in range(2)]


def alarm_of(fields: Iterable[Sequence[MarkerField]], settings: SlipSettings | None = None) -> int | None:
    """First frame at which either finger announces slip."""
    firsts = []
    for sequence in fields:
        detector = SlipDetector(settings)
        detector.rearm(sequence[0])
        firsts += [k for k, field in enumerate(sequence) if k and detector.update(field).slip][:1]
    return min(firsts, default=None)


def alarm_2019(fields: Iterable[Sequence[MarkerField]]) -> int | None:
    """The same by the rule of 2019."""
    firsts = []
    for sequence in fields:
        firsts += [k for k, field in enumerate(sequence) if field.usable and _rule_2019(field, sequence[0])][:1]
    return min(firsts, default=None)


def _rule_2019(field: MarkerField, reference: MarkerField) -> bool:
    """Dong et al. 2019: slip if more than 7 markers deviate by more than 0.30 pitch from the rigid prediction.

    The prediction is one least-squares rigid motion of all valid markers.
    """
    may = (field.valid & reference.valid).reshape(-1)
    x = (reference.rest_px + reference.displacement_px).reshape(-1, 2)[may].astype(np.float64)
    y = (field.rest_px + field.displacement_px).reshape(-1, 2)[may].astype(np.float64)
    if len(x) < 8:
        return False
    a, b = x - x.mean(0), y - y.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    off = np.sort(np.linalg.norm(b - a @ np.array([[c, s], [-s, c]]), axis=1))
    return bool(off[-8] > 0.30 * field.pitch_px)


def onset_of(fields: Iterable[Sequence[MarkerField]]) -> int | None:
    """First frame at which either finger shows motion."""
    firsts = []
    for sequence in fields:
        detector = OnsetDetector()
        detector.rearm(sequence[0])
        onsets_ns = map(detector.update, sequence[1:])
        firsts += [frame for frame, onset_ns in enumerate(onsets_ns, 1) if onset_ns is not None][:1]
    return min(firsts, default=None)


def cost_ms(trials: int, seed: int, fps: int) -> dict[str, float]:
    """CPU ms per frame of one finger to rectify, track, detect contact, slip and onset, one thread, on raw frames.

    Median and 95th percentile over ``trials`` descents.
    """
    spent = []
    for trial in draw_trials(trials, seed, fps):
        for finger, name in enumerate(FINGERS):
            renderer = Renderer(Appearance.draw(trial.scene, name, trial.seed))
            rectifier = Rectifier(renderer.calibration)
            tracker, free, slip, onset = MarkerTracker(), OpenGel(), SlipDetector(), OnsetDetector()
            for k, gel in enumerate(trial.gel):
                raw = renderer.raw(gel[finger], frame_seed(trial.seed, k, finger))
                begun = time.process_time()
                field = tracker.update(rectifier.apply(raw), round(k * 1e9 / fps))
                if k == 0:
                    slip.rearm(field)
                    onset.rearm(field)
                    continue
                slip.update(free.mark(field))
                onset.update(field)
                spent.append(1e3 * (time.process_time() - begun))
    return {"median": float(np.median(spent)), "p95": float(np.percentile(spent, 95)), "frames": len(spent)}


def evaluate(count: int, seed: int, fps: int, show: Callable[[int], None]) -> dict[str, Any]:
    """``count`` trials by the standard tracker, on true fields and by the rule of 2019; the cost of the slip path."""
    tallies = {name: Tally() for name in ("images", "held out, images", STANDING, "true fields", "2019 rule")}
    objects: dict[str, Tally] = {}
    for done, trial in enumerate(draw_trials(count, seed, fps), 1):
        images = pictures(trial)
        fields = track(trial, images)
        alarm, onset = alarm_of(fields), onset_of(fields)
        for tally in (tallies["images"], objects.setdefault(trial.name, Tally())):
            tally.add(trial, alarm)
            if trial.onset_frame >= 0 and onset is not None:
                tally.onsets.append(onset - trial.onset_frame)
        if trial.held_out:
            tallies["held out, images"].add(trial, alarm)
        without_stall = alarm_of(fields, SlipSettings(stall_pitch=math.inf))
        tallies[STANDING].add(trial, without_stall, standing=True)
        tallies["true fields"].add(trial, alarm_of(true_fields(trial)))
        tallies["2019 rule"].add(trial, alarm_2019(fields))
        show(done)
    return {
        "path_ms": cost_ms(4, seed, fps),
        "settings": asdict(TrackerSettings()) | {"seed": seed, "fps": fps, "late_frames": LATE_N},
        "slip": {name: tally.summary() for name, tally in tallies.items()},
        "objects": {name: tally.summary() for name, tally in sorted(objects.items())},
    }
