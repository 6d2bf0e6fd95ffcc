"""Slip on real recordings of gripped objects: false alarms while held, and slip against hold.

``PATH/gelsight_mini_slip/OBJECT_N_{slip,hold}/camera_*.avi``: two fingers grasp, lift and shake an object that is held
or slips. No onset is labelled, the length of a clip alone would give its label away, and closing and letting go look
like slip. So held clips are evaluated between the two, windows are matched in length, and what is fitted is evaluated
on other recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reporting.statistics import bootstrap
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.detector import SlipSettings
from service.perception.slip.grasp import WATCH_SLIP_PITCH, GraspWatch, watch_settings
from simulation.studies.slip.baselines import plain_residual

FRAME_NS = 125_000_000  # true capture was about 8 a second, whatever the files' headers say
CLOSED_N = 25  # in every clip the fingers have closed by then
HELD = slice(45, -30)  # of held clips: after grasp and lift, before the fingers open
GRID_PITCH = (0.05, 0.0625, 0.075, 0.1, 0.125, 0.15, 0.175, 0.2, 0.225, 0.25, 0.3, 0.35, 0.4)
MARGIN = 1.25
INSERTION_PITCH = SlipSettings().slip_pitch
RESAMPLES = 4000
GELSLIM_CROP = (0, 28, 384, 278)  # left, top, width, height of the sensor in the screen recording
GELSLIM_FPS = 15
CONTACT_FREE = ((3, 26), (99, 104), (188, 201), (293, 331), (423, 475), (603, 613), (643, 716))

Float64 = NDArray[np.float64]


class RealDataError(ValueError):
    """Recordings that are not where they should be."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One grasp: the marker fields of its fingers, frame by frame."""

    name: str
    slips: bool
    fingers: tuple[list[MarkerField], ...]


def frames(path: Path, crop: tuple[int, int, int, int] | None = None) -> Iterator[NDArray[np.uint8]]:
    """The frames of a clip, uint8 BGR; ``crop`` is left, top, width, height."""
    capture = cv2.VideoCapture(str(path))
    try:
        while True:
            good, frame = capture.read()
            if not good:
                return
            if crop:
                left, top, width, height = crop
                frame = np.ascontiguousarray(frame[top : top + height, left : left + width])
            yield np.asarray(frame, np.uint8)
    finally:
        capture.release()


def folders_of(root: Path) -> list[Path]:
    """The folders of the slip recordings; raises RealDataError if there are none."""
    folders = sorted(path for path in (root / "gelsight_mini_slip").glob("*_*") if path.is_dir())
    if not folders:
        raise RealDataError(f"--real {root}: expected folders gelsight_mini_slip/OBJECT_N_slip and _hold in it")
    return folders


def load(root: Path, show: Callable[[int], None]) -> list[Recording]:
    """Track every clip of the slip recordings; ``show`` gets how many are done. Raises RealDataError."""
    recordings = []
    for done, folder in enumerate(folders_of(root), 1):
        fingers = []
        for clip in sorted(folder.glob("camera_*.avi")):
            tracker = MarkerTracker()
            fingers.append([tracker.update(image, k * FRAME_NS) for k, image in enumerate(frames(clip))])
        recordings.append(Recording(folder.name, folder.name.endswith("_slip"), tuple(fingers)))
        show(done)
    return recordings


# ---- false alarms ---------------------------------------------------------------------------------------------------


def alarms(recording: Recording, slip_pitch: float) -> tuple[int, int]:
    """Frames with a slip alarm while the object is held and shaken, and all such frames, over both fingers."""
    alarmed = frames = 0
    for fields in recording.fingers:
        watch = GraspWatch(watch_settings(slip_pitch))
        states = [watch.update(field) for field in fields][HELD]
        alarmed += sum(state.slip for state in states)
        frames += len(states)
    return alarmed, frames


def caught(recording: Recording, slip_pitch: float) -> bool:
    """Whether slip is announced on either finger after the closing."""
    for fields in recording.fingers:
        watch = GraspWatch(watch_settings(slip_pitch))
        if any([watch.update(field).slip for field in fields][CLOSED_N:]):
            return True
    return False


def fitted(held: Sequence[Recording], counts: Mapping[tuple[str, float], int]) -> float:
    """The watch's limit: the least of the grid from which on no held recording raises an alarm, and a margin."""
    silent = [p for p in GRID_PITCH if not any(counts[r.name, q] for r in held for q in GRID_PITCH if q >= p)]
    return MARGIN * (silent[0] if silent else GRID_PITCH[-1])


def false_alarms(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Alarms in 1,500 held frames: at the insertion's limit, and at limits fitted on the other half of the grasps."""
    held = [recording for recording in recordings if not recording.slips]
    counts = {(r.name, pitch): alarms(r, pitch)[0] for r in held for pitch in GRID_PITCH}
    halves = (held[0::2], held[1::2])
    folds = []
    for tuned_on, rest in (halves, halves[::-1]):
        pitch = fitted(tuned_on, counts)
        pairs = [alarms(recording, pitch) for recording in rest]
        folds.append({"limit_pitch": pitch, "alarms": sum(a for a, _ in pairs), "frames": sum(n for _, n in pairs)})
    slipping = [recording for recording in recordings if recording.slips]
    at_default = [alarms(recording, WATCH_SLIP_PITCH) for recording in held]
    return {
        "recordings": len(held),
        "frames": sum(n for _, n in at_default),
        "slip_recordings": len(slipping),
        "insertion_limit": {
            "limit_pitch": INSERTION_PITCH,
            "alarms": sum(counts[recording.name, INSERTION_PITCH] for recording in held),
            "caught": sum(caught(recording, INSERTION_PITCH) for recording in slipping),
        },
        "folds": folds,
        "fitted_on_all_pitch": fitted(held, counts),
        "default": {
            "limit_pitch": WATCH_SLIP_PITCH,
            "alarms": sum(a for a, _ in at_default),
            "caught": sum(caught(recording, WATCH_SLIP_PITCH) for recording in slipping),
        },
    }


# ---- slip against hold ----------------------------------------------------------------------------------------------


def evidence(recording: Recording) -> tuple[list[Float64], list[Float64]]:
    """For each finger, frame by frame after closing: our score and the plain rigid residual (8th largest, pitch).

    Both are measured from the same reference, the last rest of the grasp.
    """
    ours, plain = [], []
    for fields in recording.fingers:
        watch = GraspWatch(watch_settings(INSERTION_PITCH))
        scores, residuals = [], []
        for field in fields:
            scores.append(watch.update(field).score)
            reference = watch.detector.reference
            known = reference is not None and field.usable
            off = plain_residual(field, reference) / field.pitch_px if known and reference is not None else np.zeros(1)
            residuals.append(float(off[min(7, len(off) - 1)]))
        ours.append(np.array(scores[CLOSED_N:]))
        plain.append(np.array(residuals[CLOSED_N:]))
    return ours, plain


def _wins(slips: Sequence[Sequence[Float64]], holds: Sequence[Sequence[Float64]]) -> Float64:
    """1 where the slip recording has the larger maximum within the shorter one's length, 0.5 where equal."""
    table = np.zeros((len(slips), len(holds)))
    for i, slip in enumerate(slips):
        for j, hold in enumerate(holds):
            n = min(*(len(series) for series in slip), *(len(series) for series in hold))
            x, y = max(float(series[:n].max()) for series in slip), max(float(series[:n].max()) for series in hold)
            table[i, j] = float(x > y) + 0.5 * float(x == y)
    return table


def separation(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Area under the ROC curve, slip against hold, for our score and the plain residual; 95 % bootstrap intervals.

    Every slip recording is compared with every held one over windows of the same length from the closing of the
    fingers on, whole recordings are resampled. Nothing is fitted.
    """
    scores = {recording.name: evidence(recording) for recording in recordings}
    slips = [recording.name for recording in recordings if recording.slips]
    holds = [recording.name for recording in recordings if not recording.slips]
    ours, plain = (_wins([scores[n][k] for n in slips], [scores[n][k] for n in holds]) for k in (0, 1))
    rng = np.random.default_rng(0)
    drawn = [
        np.ix_(rng.integers(0, len(slips), len(slips)), rng.integers(0, len(holds), len(holds)))
        for _ in range(RESAMPLES)
    ]
    same = np.array([[a.rsplit("_", 2)[0] == b.rsplit("_", 2)[0] for b in holds] for a in slips])
    result: dict[str, Any] = {"slip_recordings": len(slips), "hold_recordings": len(holds)}
    for name, table in (("ours", ours), ("plain", plain), ("margin", ours - plain)):
        value, *interval = bootstrap(float(table.mean()), [float(table[pick].mean()) for pick in drawn])
        result[name] = {"value": value, "interval": interval, "same_object": float(table[same].mean())}
    return result


# ---- markers come home ----------------------------------------------------------------------------------------------


def loop_closure(root: Path) -> dict[str, Any] | None:
    """GelSlim 3, None without the clip: share of markers more than 0.25 pitch off when nothing touches the gel.

    And whether that is detected: the share of frames reported as untouched, the first one learnt as such, where
    nothing touches the gel and elsewhere (the labelled stretches are shorter than the true ones).
    """
    clip = root / "gelslim3_press" / "sample_realtime_depth.mp4"
    if not clip.is_file():
        return None
    tracker, watch = MarkerTracker(), GraspWatch()
    off, alone = [], []
    for k, image in enumerate(frames(clip, GELSLIM_CROP)):
        field = tracker.update(image, round(k * 1e9 / GELSLIM_FPS))
        if k == 0:
            watch.free.learn(field)
        alone.append(watch.update(field).state == "no_contact")
        off.append(float((np.linalg.norm(field.displacement_px, axis=-1) > 0.25 * field.pitch_px).mean()))
    free = [max(off[begin:end]) for begin, end in CONTACT_FREE]
    labelled = np.zeros(len(off), np.bool_)
    for begin, end in CONTACT_FREE:
        labelled[begin:end] = True
    untouched = np.array(alone)
    return {
        "frames": len(off),
        "worst_share": max(free),
        "end_share": off[CONTACT_FREE[-1][1] - 1],
        "untouched_seen": float(untouched[labelled].mean()),
        "untouched_elsewhere": float(untouched[~labelled].mean()),
    }


def evaluate(root: Path, show: Callable[[int], None]) -> dict[str, Any]:
    """All three evaluations; raises RealDataError."""
    recordings = load(root, show)
    return {
        "false_alarms": false_alarms(recordings),
        "slip_against_hold": separation(recordings),
        "loop_closure": loop_closure(root),
    }
