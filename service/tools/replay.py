"""Perception over a recorded clip, event by event.

A clip is a video, a folder of frames (png or jpg, by name), or a folder of videos (one a finger).
"""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.cameras.sources import IMAGES, clip_images
from service.contract import Finger
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import Calibration, Rectifier
from service.perception.slip.detector import SlipState
from service.perception.slip.grasp import GraspWatch
from service.tools.replay_picture import ReplayPicture

VIDEOS = {".avi", ".mp4", ".mov", ".mkv", ".webm"}


class ReplayError(ValueError):
    """A clip that cannot be replayed; the text gives what is there and what was expected."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """The options of the command line; ``crop`` is left, top, width, height in pixels."""

    path: Path
    plot: bool = False
    out: Path = Path("runs/replay")
    crop: tuple[int, int, int, int] | None = None
    fps: float | None = None
    calibration: Path | None = None
    finger: Finger = "left"
    untouched: bool = False


def clips_of(path: Path) -> list[Path]:
    """The clips of a path."""
    if not path.exists():
        raise ReplayError(f"no recording at {path}: expected a video, a folder of frames or a folder of videos")
    if path.is_file():
        return [path]
    videos = sorted(child for child in path.iterdir() if child.suffix.lower() in VIDEOS)
    if videos:
        return videos
    if any(child.suffix.lower() in IMAGES for child in path.iterdir()):
        return [path]
    raise ReplayError(f"{path} holds neither videos nor frames")


def read_clip(path: Path, fps: float | None) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Stamp in ns and BGR image of every frame, in order."""
    if fps is not None and not 0 < fps < 10_000:
        raise ReplayError(f"--fps is {fps}, expected frames a second above 0")
    k = -1
    for k, (image, rate_hz) in enumerate(clip_images(path)):
        yield round(k * 1e9 / (fps or rate_hz)), image
    if k < 0:
        raise ReplayError(f"{path} holds no frame that can be decoded")


def replay(path: Path, options: ReplayOptions) -> list[SlipState]:
    """Run one clip, print its events and the cost a frame; returns the states."""
    rectifier = None
    if options.calibration:
        rectifier = Rectifier(Calibration.load(options.calibration).camera(options.finger))
    tracker, watch = MarkerTracker(), GraspWatch()
    states: list[SlipState] = []
    tracks: Counter[str] = Counter()
    spent_s, last = 0.0, ""
    base = options.out / f"{path.parent.name}_{path.stem}"
    picture = ReplayPicture(base, options.fps or 15.0, video=options.plot)
    print(f"{path}")
    for stamp_ns, frame in read_clip(path, options.fps):
        image = rectifier.apply(frame) if rectifier else _cropped(frame, options.crop, path)
        begun = time.process_time()
        field = tracker.update(image, stamp_ns)
        if options.untouched and not states:
            watch.free.learn(field)
        state = watch.update(field)
        spent_s += time.process_time() - begun
        states.append(state)
        tracks[field.status] += 1
        if state.state != last:
            print(f"  {stamp_ns * 1e-9:8.2f} s  {state.state:<15} score {state.score:5.2f}  {state.reason}")
            last = state.state
        picture.add(image, field, state)
    grid = tracker.grid_shape
    described = f"grid of {grid[0]} rows x {grid[1]} columns" if grid else "no marker grid"
    summary = ", ".join(f"{count} {status}" for status, count in tracks.items())
    print(f"  {described}; {summary}; {1e3 * spent_s / len(states):.2f} ms CPU a frame")
    print(f"  wrote {' and '.join(map(str, picture.close(states)))}")
    return states


def _cropped(frame: NDArray[np.uint8], crop: tuple[int, int, int, int] | None, path: Path) -> NDArray[np.uint8]:
    if crop is None:
        return frame
    left, top, width, height = crop
    if min(left, top) < 0 or min(width, height) < 1 or left + width > frame.shape[1] or top + height > frame.shape[0]:
        raise ReplayError(f"--crop {crop} leaves the {frame.shape[1]} x {frame.shape[0]} frames of {path}")
    return np.ascontiguousarray(frame[top : top + height, left : left + width])
