"""Judges recorded grasps run by run, with the live detector: tracker, grasp watch, open gel, phases.

A run is a folder with one video per finger; a video in which hardly any frame shows the gel's markers is none of them.
A recording does not state the open gel before the grasp, so it is sought in the run's own frames (`rest`). That choice
uses the whole run; everything after it uses only earlier frames. Moments at which all fingers' frames repeat the ones
before are none.
"""

import itertools
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.recorded import clip_images, stated_frames_n
from service.perception.markers.lattice import DIAMETERS_PX, find_lattice
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.imprint import ImprintWatch
from service.perception.slip.open_gel import shrunk
from service.perception.slip.phases import EMPTY_N, ENDED, Grasp, Phase
from service.perception.slip.slide import SlideWitness, slide_score
from service.tools.finger_run import Felt, FingerRun, new_frames
from service.tools.live import stops_of
from service.tools.open_frame import rest

RATE_HZ = 8.0  # of the recordings the thresholds were set with; headers are wrong about the rate
VIDEOS = {".avi", ".mp4", ".mov", ".mkv", ".webm"}
PHASES: tuple[Phase, ...] = ("open", "contact", "hold", "slip", "lost", "released")
_LEAST_PX = 64
_SMALL_PX, _LARGE_PX, _REDUCED_PX = 312, 480, 240  # smaller side; the filters are made for small pictures
_SOUGHT_N = 30  # first frames in which a grid is sought, to know how large its markers are
_BUFFERED_N = 16  # first frames, in which a camera may still deliver pictures of an earlier grasp


_FINGERS_N = 2
Image = NDArray[np.uint8]


class RunError(ValueError):
    """Recordings are not in the expected place."""


def watched(clip: Path, step: int = 1, rate_hz: float = RATE_HZ) -> FingerRun:
    """Every ``step``-th frame of one finger's recording, ``rate_hz``, through tracker, grasp watch and imprint.

    Raises RunError if it has no frames, or small ones; CameraError for its name.
    """
    run, tracker, watch, imprint = FingerRun(), MarkerTracker(), GraspWatch(), ImprintWatch()
    shrink = _shrink(clip)
    for whole, _ in clip_images(clip):
        run.frames_n += 1
        if (run.frames_n - 1) % step:
            continue
        if min(whole.shape[:2]) < _LEAST_PX:
            raise RunError(f"{clip} is {whole.shape[1]} x {whole.shape[0]}, expected {_LEAST_PX} px a side or more")
        begun = time.process_time()
        image = _reduced(whole, shrink)
        markers = tracker.update(image, round(len(run.fields) * 1e9 / rate_hz))
        state = watch.update(markers)
        change = imprint.update(image, markers)
        picture = shrunk(image)
        run.spent_s += time.process_time() - begun
        run.pictures.append(np.rint(picture).astype(np.uint8))
        run.fields.append(markers)
        run.scores.append(state.score)
        run.slips.append(state.slip)
        run.changes.append(change)
    if not run.fields:
        raise RunError(f"{clip} holds no frame that can be decoded")
    run.missing_n = max(0, stated_frames_n(clip) - run.frames_n)
    return run


def _shrink(clip: Path) -> float:
    """By how much a clip's pictures are reduced to be 240 px high, as a session's rectified ones are; 1: not at all.

    Of those that are only somewhat larger, this depends on their markers, which must stay large enough to be found.
    """
    for picture, _ in itertools.islice(clip_images(clip), _SOUGHT_N):
        side_px = int(min(picture.shape[:2]))
        shrink = side_px / _REDUCED_PX
        if side_px < _SMALL_PX:
            return 1.0
        if side_px >= _LARGE_PX:
            return shrink
        lattice = find_lattice(picture)
        if lattice is not None:
            return shrink if lattice.diameter_px >= DIAMETERS_PX[0] * shrink else 1.0
    return 1.0


def _reduced(image: Image, shrink: float) -> Image:
    if shrink == 1:
        return image
    size = (round(image.shape[1] / shrink), round(image.shape[0] / shrink))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True, slots=True)
class RunReport:
    """The row of one run, the slide witness's readings in each frame, None before the first, and what was odd."""

    row: dict[str, Any]
    evidence: list[list[float] | None]
    remarks: list[str]


def report_of(folder: Path, step: int = 1, rate_hz: float = RATE_HZ) -> RunReport:
    """One run up to the end of its shortest video; RunError if a video cannot be used.

    Every ``step``-th frame is judged, ``rate_hz`` of them a second; the row counts them as in the recording, and the
    evidence has only these.
    """
    videos = clips_of(folder)
    if len({clip.stem for clip in videos}) < len(videos):
        raise RunError(f"two of its videos have one name: {', '.join(clip.name for clip in videos)}")
    every = {clip.stem: watched(clip, step, rate_hz) for clip in videos}
    missing_n = sum(finger.missing_n for finger in every.values())
    remarks = [f"{missing_n} frames of its videos cannot be decoded: damaged or cut off"] if missing_n else []
    shown = _gels(every)
    remarks += [f"{name} shows no marker grid, and is left out" for name in every if name not in shown]
    clips = shown or every
    fingers = list(clips.values())
    if len(clips) < _FINGERS_N:
        remarks.append("one finger's video alone: whether the object slides is not known")
    if any(finger.shows_gel and finger.is_grey for finger in fingers):
        remarks.append("grey pictures: the limits were set in colour")
    frames_n, most_n = (extreme(len(finger.fields) for finger in fingers) for extreme in (min, max))
    if most_n - frames_n > rate_hz:
        remarks.append(f"one video is longer by {(most_n - frames_n) * step} frames, which are left out")
    new = new_frames(fingers)
    numbers, fresh = [k * step for k in new], [finger.only(new) for finger in fingers]
    still = rest([finger.pictures for finger in fresh], [finger.fields for finger in fresh])
    open_frame = numbers[still.frame] if still is not None and still.is_open else None
    if open_frame is None:
        remarks.append("no frame shows open gels: they count as touched throughout, and an end cannot be shown")
    evidence = _evidence(fingers, frames_n)
    slides = [terms is not None and bool(slide_score(terms) >= 0) for terms in (evidence[k] for k in new)]
    statuses = [markers.status for finger in fingers for markers in finger.fields]
    felt = [finger.felt(still) for finger in fresh]
    whole, *alone = _stories(fresh, felt, slides, numbers)
    row = {
        "frames_n": min(finger.frames_n for finger in fingers),
        **whole,
        "fingers": {
            name: {"frames_n": finger.frames_n, **story}
            for (name, finger), story in zip(clips.items(), alone, strict=True)
        },
        "live": _live([clip for clip in videos if clip.stem in clips], open_frame, whole, step, rate_hz),
        "open_frame": open_frame,
        "ambiguous_n": statuses.count("ambiguous"),
        "refused_n": sum(status in {"lost", "no_grid", "duplicate"} for status in statuses),
        "missing_n": missing_n,
        "ms_a_frame": 1e3 * sum(finger.spent_s for finger in fresh) / len(statuses),
    }
    return RunReport(row, [None if terms is None else terms.tolist() for terms in evidence], remarks)


def _live(
    videos: Sequence[Path], open_frame: int | None, whole: dict[str, Any], step: int, rate_hz: float
) -> dict[str, Any] | None:
    """When the session's own detector would stop an arm in the held grasp; None without one, or without two gels."""
    begin = whole["hold_frame"]
    if begin is None or len(videos) < _FINGERS_N:
        return None
    ends = [whole[f"{end}_frame"] // step - EMPTY_N + 1 for end in ENDED if whole[f"{end}_frame"] is not None]
    held = range(begin // step, min(ends, default=sys.maxsize))
    opened = None if open_frame is None else open_frame // step
    live = stops_of(lambda: zip(*(_pictures(clip, step) for clip in videos), strict=False), opened, held, rate_hz)
    return {key: [k * step for k in value] if key.endswith("_frames") else value for key, value in live.items()}


def _pictures(clip: Path, step: int) -> Iterator[Image]:
    shrink = _shrink(clip)
    return (_reduced(whole, shrink) for whole, _ in itertools.islice(clip_images(clip), 0, None, step))


def _evidence(fingers: Sequence[FingerRun], frames_n: int) -> list[NDArray[np.float64] | None]:
    """The witness's latest reading, in each frame."""
    witness = SlideWitness()
    last: list[NDArray[np.float64] | None] = [None]
    for k in range(frames_n):
        terms = witness.terms([finger.changes[k] for finger in fingers])
        last.append(last[-1] if terms is None else terms)
    return last[1:]


def _stories(
    fingers: Sequence[FingerRun], felt: Sequence[Sequence[Felt]], slides: Sequence[bool], numbers: Sequence[int]
) -> list[dict[str, Any]]:
    """For the grasp and each finger: the first frame of each phase, null if it never came, and the largest scores.

    ``numbers`` are the frames' in the recording.
    The grasp slips by the slide witness, a finger by its markers. ``borne_frames``: something else bore the object.
    """
    grasp = Grasp(len(fingers))
    followed = [grasp.whole, *grasp.fingers]
    phases: list[list[Phase]] = [[] for _ in followed]
    borne: list[list[int]] = [[] for _ in followed]
    for k, slides_now in enumerate(slides):
        touches, loads = zip(*(gel[k] for gel in felt), strict=True)
        grasp.update(touches, [finger.slips[k] for finger in fingers], slides=slides_now, loads=loads)
        for one, history, frames in zip(followed, phases, borne, strict=True):
            history.append(one.phase)
            if one.borne:
                frames.append(numbers[k])
    return [
        {**_firsts(history, numbers), "borne_frames": frames, "largest_score": _largest(history, whose)}
        for history, frames, whose in zip(phases, borne, [fingers, *([finger] for finger in fingers)], strict=True)
    ]


def _firsts(phases: list[Phase], numbers: Sequence[int]) -> dict[str, int | None]:
    """First frame of each phase of the first held grasp, or else of the first touch.

    A grasp that ends within the first frames counts only if none follows.
    """
    begins = [k for k, (last, now) in enumerate(zip(["open", *phases], phases, strict=False)) if _begins(last, now)]
    grasps = [phases[begin:end] for begin, end in zip(begins, [*begins, len(phases)][1:], strict=True)]
    order = sorted(
        range(len(grasps)),
        key=lambda k: ("hold" not in grasps[k], bool(ENDED & {*grasps[k][: max(0, _BUFFERED_N - begins[k])]}), k),
    )
    first: dict[str, int | None] = {f"{phase}_frame": None for phase in PHASES[1:]}
    for chosen in order[:1]:
        first |= {
            f"{phase}_frame": numbers[begins[chosen] + grasps[chosen].index(phase)]
            for phase in PHASES[1:]
            if phase in grasps[chosen]
        }
    return first


def _gels(every: Mapping[str, FingerRun]) -> dict[str, FingerRun]:
    """The videos that show a gel; RunError unless they can be of a finger each."""
    shown = {name: finger for name, finger in every.items() if finger.shows_gel}
    for one, other in itertools.combinations(shown, 2):
        if shown[one].same_pictures(shown[other]):
            raise RunError(f"{one} and {other} have the same pictures, expected a video of each finger")
    if len(shown) > _FINGERS_N:
        raise RunError(f"{len(shown)} videos show a gel, expected one of each finger: {', '.join(shown)}")
    return shown


def _begins(last: Phase, now: Phase) -> bool:
    return now == "contact" and (last == "open" or last in ENDED)


def _largest(phases: list[Phase], fingers: Sequence[FingerRun]) -> dict[str, float]:
    largest: dict[str, float] = dict.fromkeys(PHASES, 0.0)
    for k, phase in enumerate(phases):
        largest[phase] = max(largest[phase], *(finger.scores[k] for finger in fingers))
    return largest


def runs_of(folder: Path) -> Iterator[Path]:
    """The folders that hold videos: ``folder``, those in it and those one level further down. RunError if none."""
    if not folder.is_dir():
        raise RunError(f"no folder {folder}: expected runs of one video a finger")
    runs = [run for run in (folder, *sorted(folder.glob("*")), *sorted(folder.glob("*/*"))) if clips_of(run)]
    if not runs:
        raise RunError(f"{folder}: expected runs, folders of one video a finger")
    yield from runs


def without_videos(folder: Path, runs: Sequence[Path]) -> list[Path]:
    """The folders in ``folder``, and those beside its ``runs``, in which a run was expected and no video lies."""
    beside = {run.parent for run in runs if run != folder} | ({folder} - {*runs})
    holding = {*runs, *(run.parent for run in runs)}
    others = {path for parent in beside for path in parent.glob("*") if path.is_dir() and path.name[0] != "."}
    return sorted(others - holding)


def clips_of(folder: Path) -> list[Path]:
    """The videos that lie in a folder, by name; hidden files are none."""
    return sorted(
        clip
        for clip in folder.glob("*")
        if clip.suffix.lower() in VIDEOS and clip.is_file() and not clip.name.startswith(".")
    )
