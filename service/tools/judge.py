"""Judges recorded grasps run by run, with the live detector: tracker, grasp watch, open gel, phases.

A run is a folder with one video per finger. A recording does not state the open gel before the grasp, so it is sought
in the run's own frames (`rest`). That choice uses the whole run; everything after it uses only earlier frames.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.cameras.sources import clip_images
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.imprint import ImprintChange, ImprintWatch
from service.perception.slip.open_gel import OpenGel, shrunk
from service.perception.slip.phases import ENDED, Grasp, Phase
from service.perception.slip.rigid import Float64
from service.perception.slip.slide import SlideWitness, slide_score
from service.tools.open_frame import Rest, rest

FRAME_NS = 125_000_000  # headers are wrong about the rate; these sensors deliver about eight frames per second
VIDEOS = {".avi", ".mp4", ".mov", ".mkv", ".webm"}
PHASES: tuple[Phase, ...] = ("open", "contact", "hold", "slip", "lost", "released")
_LEAST_PX = 64
_BUFFERED_N = 16  # first frames, in which a camera may still deliver pictures of an earlier grasp


class RunError(ValueError):
    """Recordings are not in the expected place."""


class Felt(NamedTuple):
    """`OpenGel.touch` and `OpenGel.load` of one frame."""

    touch: float | None
    load: Float64 | None


@dataclass(slots=True)
class FingerRun:
    """One finger's recording after perception, frame by frame; slip score and alarm come from its markers alone."""

    fields: list[MarkerField] = field(default_factory=list)
    pictures: list[NDArray[np.uint8]] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    slips: list[bool] = field(default_factory=list)
    changes: list[ImprintChange | None] = field(default_factory=list)
    spent_s: float = 0.0

    def felt(self, still: Rest | None) -> list[Felt]:
        """What the gel feels in each frame, compared with the frame at rest.

        Unless it is open in that, it counts as touched wherever its markers are visible: an end cannot be shown then.
        """
        touches: list[float | None] = [1.0 if markers.usable else None for markers in self.fields]
        if still is None:
            return [Felt(touch, None) for touch in touches]
        begun, gel = time.process_time(), OpenGel()
        gel.learn(self.fields[still.frame], self.pictures[still.frame].astype(np.float32))
        if still.is_open:
            touches = [
                gel.touch(markers, picture.astype(np.float32))
                for markers, picture in zip(self.fields, self.pictures, strict=True)
            ]
        felt = [Felt(touch, gel.load(markers)) for touch, markers in zip(touches, self.fields, strict=True)]
        self.spent_s += time.process_time() - begun
        return felt


def watched(clip: Path) -> FingerRun:
    """One finger's recording through tracker, grasp watch and imprint. RunError: no frames, small ones, or its name."""
    if any("\ud800" <= letter <= "\udfff" for letter in str(clip)):
        raise RunError(f"the name {str(clip)!a} is no UTF-8, and OpenCV would crash on it: rename it")
    run, tracker, watch, imprint = FingerRun(), MarkerTracker(), GraspWatch(), ImprintWatch()
    for k, (image, _) in enumerate(clip_images(clip)):
        if min(image.shape[:2]) < _LEAST_PX:
            raise RunError(f"{clip} is {image.shape[1]} x {image.shape[0]}, expected {_LEAST_PX} px a side or more")
        begun = time.process_time()
        markers = tracker.update(image, k * FRAME_NS)
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
    return run


@dataclass(frozen=True, slots=True)
class RunReport:
    """The row of one run, and the slide witness's readings in each frame, None before the first."""

    row: dict[str, Any]
    evidence: list[list[float] | None]


def report_of(folder: Path) -> RunReport:
    """One run, up to the end of its shortest video; raises RunError if one of its videos cannot be used."""
    clips = clips_of(folder)
    fingers = [watched(clip) for clip in clips]
    frames_n = min(len(finger.fields) for finger in fingers)
    still = rest([finger.pictures for finger in fingers], [finger.fields for finger in fingers])
    evidence = _evidence(fingers, frames_n)
    slides = [terms is not None and bool(slide_score(terms) >= 0) for terms in evidence]
    statuses = [markers.status for finger in fingers for markers in finger.fields]
    felt = [finger.felt(still) for finger in fingers]
    whole, *alone = _stories(fingers, felt, slides)
    row = {
        "run": folder.name,
        "frames_n": frames_n,
        **whole,
        "fingers": {
            clip.stem: {"frames_n": len(finger.fields), **story}
            for clip, finger, story in zip(clips, fingers, alone, strict=True)
        },
        "open_frame": still.frame if still is not None and still.is_open else None,
        "ambiguous_n": statuses.count("ambiguous"),
        "refused_n": sum(status in {"lost", "no_grid", "duplicate"} for status in statuses),
        "ms_a_frame": 1e3 * sum(finger.spent_s for finger in fingers) / len(statuses),
    }
    return RunReport(row, [None if terms is None else terms.tolist() for terms in evidence])


def _evidence(fingers: Sequence[FingerRun], frames_n: int) -> list[NDArray[np.float64] | None]:
    """The witness's latest reading, in each frame."""
    witness = SlideWitness()
    last: list[NDArray[np.float64] | None] = [None]
    for k in range(frames_n):
        terms = witness.terms([finger.changes[k] for finger in fingers])
        last.append(last[-1] if terms is None else terms)
    return last[1:]


def _stories(
    fingers: Sequence[FingerRun], felt: Sequence[Sequence[Felt]], slides: Sequence[bool]
) -> list[dict[str, Any]]:
    """For the grasp and each finger: the first frame of each phase, null if it never came, and the largest scores.

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
                frames.append(k)
    return [
        {**_firsts(history), "borne_frames": frames, "largest_score": _largest(history, whose)}
        for history, frames, whose in zip(phases, borne, [fingers, *([finger] for finger in fingers)], strict=True)
    ]


def _firsts(phases: list[Phase]) -> dict[str, int | None]:
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
            f"{phase}_frame": begins[chosen] + grasps[chosen].index(phase)
            for phase in PHASES[1:]
            if phase in grasps[chosen]
        }
    return first


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


def clips_of(folder: Path) -> list[Path]:
    """The videos that lie in a folder, by name."""
    return sorted(clip for clip in folder.glob("*") if clip.suffix.lower() in VIDEOS and clip.is_file())
