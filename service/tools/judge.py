"""Recorded grasps judged run by run, by the detector that runs live: tracker, grasp watch, open gel, phases.

A run is a folder with one video a finger. What a recording cannot tell, the open gel before the grasp, is taken from
the run's own frames: the one whose gel looks least touched, its markers and colours smoothest across the gel. That
choice knows the whole run; everything after it sees only what came before.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.cameras.sources import clip_images
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.open_gel import OpenGel, cell_colours
from service.perception.slip.phases import GraspPhases, Phase
from service.tools.replay import VIDEOS

FRAME_NS = 125_000_000  # headers lie about the rate; these sensors deliver about eight frames a second
PHASES: tuple[Phase, ...] = ("open", "contact", "hold", "slip", "lost")
_JUMP_PITCH = 0.6
_STARTED_N = 4  # frames that are never taken for the open gel
_TINTED = 0.15  # colours that are this much off the usual ones are those of a camera just started
_SETTLED_N = 13  # frames in which a camera that was just started finds its exposure and colours


class JudgeError(ValueError):
    """Recordings that are not where they should be."""


@dataclass(slots=True)
class FingerRun:
    """One finger's recording after perception: markers, colours between them, slip score and alarm, frame by frame."""

    fields: list[MarkerField] = field(default_factory=list)
    colours: list[NDArray[np.float64]] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    slips: list[bool] = field(default_factory=list)
    spent_s: float = 0.0

    def touches(self) -> list[float | None]:
        """How strongly the gel is touched in each frame, against the run's own open gel."""
        opened = self._open_frame()
        if opened is None:
            return [None] * len(self.fields)
        gel = OpenGel()
        gel.learn_colours(self.colours[opened], self.fields[opened])
        return [
            gel.compare(colours, seen) if seen.usable and k >= _SETTLED_N and not jumped else None
            for k, (colours, seen, jumped) in enumerate(zip(self.colours, self.fields, self.jumps(), strict=True))
        ]

    def jumps(self) -> list[bool]:
        """In which frames the grid jumped by what may be a whole pitch: they decide nothing."""
        return [
            _step(last, seen) > _JUMP_PITCH
            for last, seen in zip([self.fields[0], *self.fields[:-1]], self.fields, strict=True)
        ]

    def _open_frame(self) -> int | None:
        """The frame whose markers and colours leave a smooth surface least, of those that show the whole grid."""
        tint = np.array([np.median(colours.reshape(-1, 3), 0) if colours.size else 3 * [0] for colours in self.colours])
        usual = np.abs(tint / np.maximum(np.median(tint[_SETTLED_N:] if len(tint) > _SETTLED_N else tint, 0), 1) - 1)
        fair = usual.max(1) < _TINTED
        usable = [k for k, seen in enumerate(self.fields) if seen.usable and fair[k] and k >= _STARTED_N]
        if not usable:
            return None
        rough = np.array([_roughness(self.colours[k], self.fields[k]) for k in usable])
        level = (rough / np.median(rough, axis=0)).sum(1)
        calm = np.convolve(np.pad(level, 2, "edge"), np.ones(5) / 5, "valid")
        return usable[int(calm.argmin())]


def _step(last: MarkerField, seen: MarkerField) -> float:
    """Median way of the markers from one frame to the next, pitches; 0 where either shows none."""
    if last.valid.shape != seen.valid.shape or not (may := last.valid & seen.valid).any():
        return 0.0
    way = np.median((seen.displacement_px - last.displacement_px)[may], axis=0)
    return float(np.linalg.norm(way)) / seen.pitch_px


def _roughness(colours: NDArray[np.float64], seen: MarkerField) -> tuple[float, float]:
    """RMS distance of colours and of markers from cubic surfaces over the grid: an open gel is smooth."""
    places = (seen.rest_px + seen.displacement_px).astype(np.float64)
    brightness = max(float(colours.mean()), 1.0)
    return _off_surface(colours) / brightness + 1e-6, _off_surface(places) / seen.pitch_px + 1e-6


def _off_surface(values: NDArray[np.float64]) -> float:
    rows, columns = values.shape[:2]
    v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    terms = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], -1).reshape(rows * columns, -1)
    basis = np.linalg.qr(terms)[0]
    flat = values.reshape(rows * columns, -1)
    return float(np.sqrt(np.square(flat - basis @ (basis.T @ flat)).mean()))


def watched(clip: Path) -> FingerRun:
    """One finger's recording through tracker and grasp watch. Raises JudgeError if it holds no frame."""
    run, tracker, watch = FingerRun(), MarkerTracker(), GraspWatch()
    for k, (image, _) in enumerate(clip_images(clip)):
        begun = time.process_time()
        seen = tracker.update(image, k * FRAME_NS)
        state = watch.update(seen)
        run.colours.append(cell_colours(image, seen) if seen.valid.size else np.zeros((0, 0, 3)))
        run.spent_s += time.process_time() - begun
        run.fields.append(seen)
        run.scores.append(state.score)
        run.slips.append(state.slip)
    if not run.fields:
        raise JudgeError(f"{clip} holds no frame that can be decoded")
    return run


def judged(folder: Path) -> dict[str, Any]:
    """The row of one run; raises JudgeError if it is none."""
    clips = sorted(child for child in folder.iterdir() if child.suffix.lower() in VIDEOS)
    if not clips:
        raise JudgeError(f"{folder} holds no video, expected one a finger")
    fingers = [watched(clip) for clip in clips]
    frames_n = min(len(finger.fields) for finger in fingers)
    touches = [finger.touches()[:frames_n] for finger in fingers]
    grasp = _story(fingers, touches, frames_n)
    statuses = [seen.status for finger in fingers for seen in finger.fields]
    return {
        "run": folder.name,
        "frames_n": frames_n,
        **grasp,
        "fingers": {
            clip.stem: _story([finger], [touch], frames_n)
            for clip, finger, touch in zip(clips, fingers, touches, strict=True)
        },
        "ambiguous_n": sum(sum(finger.jumps()) for finger in fingers),
        "refused_n": sum(status in {"lost", "no_grid", "duplicate"} for status in statuses),
        "ms_a_frame": 1e3 * sum(finger.spent_s for finger in fingers) / len(statuses),
    }


def _story(fingers: list[FingerRun], touches: list[list[float | None]], frames_n: int) -> dict[str, Any]:
    """First frame of each phase, null where it never came, and the largest slip score in each."""
    phases = GraspPhases()
    first: dict[str, int | None] = {f"{phase}_frame": None for phase in PHASES[1:]}
    largest = dict.fromkeys(PHASES, 0.0)
    for k in range(frames_n):
        phase = phases.update([touch[k] for touch in touches], slips=any(finger.slips[k] for finger in fingers))
        if phase != "open" and first[f"{phase}_frame"] is None:
            first[f"{phase}_frame"] = k
        largest[phase] = max(largest[phase], *(finger.scores[k] for finger in fingers))
    return {**first, "largest_score": largest}


def runs_of(folder: Path) -> Iterator[Path]:
    """The folders of runs below ``folder``: those that hold videos, in its own folders or one level further down."""
    if not folder.is_dir():
        raise JudgeError(f"no folder {folder}: expected runs of one video a finger")
    runs = sorted({clip.parent for clip in folder.glob("*/*") if clip.suffix.lower() in VIDEOS})
    deeper = sorted({clip.parent for clip in folder.glob("*/*/*") if clip.suffix.lower() in VIDEOS})
    if not runs and not deeper:
        raise JudgeError(f"{folder}: expected runs, folders of one video a finger")
    yield from deeper or runs
