"""Perception of one finger from the simulated gel itself, for runs without pictures.

The service's own detectors judge slip and onset on the true marker field plus the tracker's measured error; a picture
is drawn only when a network needs it, or where the markers show no touch. About five times cheaper than drawing and
tracking every frame.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS, Finger, TactileFrame
from service.perception.markers.field import MarkerField, empty_field, field_from_gel
from service.perception.observation import Observation
from service.perception.rectification import Rectifier
from service.perception.slip.detector import SlipDetector
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.open_gel import OpenGel, shrunk
from simulation.closed_loop.lockstep import Image, LockstepCell, hash_seed

# RMS per axis at 2 grey levels of camera noise, and the increase per further grey level (docs/slip_report.md).
TRACKING_PX = 0.039
TRACKING_PX_PER_GREY = 0.0038
COPIES_N = 2  # repeated pictures after which the service recognises the repetition; the first one it doubts


class LatePicture:
    """An image that is drawn and rectified when numpy first asks for its pixels."""

    def __init__(self, draw: Callable[[], Image], rectifier: Rectifier) -> None:
        self._draw = draw
        self._rectifier = rectifier
        self._pixels: Image | None = None

    def __array__(self, dtype: Any = None, *, copy: bool | None = None) -> Image:
        """Uint8 [H, W, 3]."""
        if self._pixels is None:
            self._pixels = self._rectifier.apply(self._draw())
        return self._pixels


Kind = Literal["dark", "frozen", "stuck", "dropped"]


@dataclasses.dataclass(frozen=True, slots=True)
class Fault:
    """A fault in what the fingers see or hold, permanent from ``depth_mm`` of the descent of ``attempt`` on.

    dark: no marker is found. frozen: the same frame again and again. stuck: the same picture with new camera noise.
    dropped: the object has left the hand, unnoticed by the gripper. A negative depth: since the hand was open. If an
    attempt ends above the depth, the fault waits for the next one.
    """

    kind: Kind
    fingers: tuple[Finger, ...] = FINGERS
    attempt: int = 1
    depth_mm: float = 0.0


class Trouble:
    """The effect of a fault on one finger in one insertion, regrasps included.

    ``copies``: number of repeated pictures from a stuck camera.
    """

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self.struck = False
        self.copies = 0
        self._attempt, self._top_mm = 0, math.inf

    def rearmed(self, height_mm: float) -> None:
        """An attempt begins at this height."""
        self._attempt, self._top_mm = self._attempt + 1, height_mm

    def strikes(self, height_mm: float) -> bool:
        """Whether it acts with the arm at this height."""
        fault = self.fault
        deep = self._attempt >= fault.attempt and self._top_mm - height_mm >= fault.depth_mm
        self.struck = self.struck or fault.depth_mm < 0.0 or deep
        return self.struck

    @property
    def gone(self) -> bool:
        """Whether the object has left the hand, whatever the mechanics report."""
        return self.struck and self.fault.kind == "dropped"

    def marked(self, field: MarkerField) -> MarkerField:
        """The field, marked as a repeated picture where the tracker finds it to be one.

        A copy with fresh noise is recognised from the second one on: see `service.perception.markers.liveness`.
        """
        known = self.fault.kind == "frozen" or (self.fault.kind == "stuck" and self.copies >= COPIES_N)
        return dataclasses.replace(field, status="duplicate") if known else field

    @property
    def doubted(self) -> bool:
        """Whether the picture may be a copy: the first one of a stuck camera is doubted."""
        return self.fault.kind == "stuck" and self.copies == 1


class TrueFieldFinger:
    """A :class:`FingerWatch` that looks at the cell's gel of this moment instead of the frame."""

    def __init__(self, cell: LockstepCell, finger: Finger, trouble: Trouble | None = None) -> None:
        self._trouble = trouble
        self._gel: NDArray[np.floating] | None = None
        self._cell = cell
        self._finger = finger
        self._index = FINGERS.index(finger)
        self._rectifier = Rectifier(cell.calibration(self._index))
        self._slip = SlipDetector()
        self._onset = OnsetDetector()
        self._open = OpenGel()
        self._home: MarkerField | None = None  # the open gel, of which no picture has been drawn yet
        self._rearm = False
        self._last_ns: int | None = None  # stamp of the frame before
        self.gel_distance: float | None = None
        noise = cell.scene.camera.noise_grey
        self._error_px = max(0.02, TRACKING_PX + TRACKING_PX_PER_GREY * (noise - 2.0))

    def rearm(self) -> None:
        """The next frame becomes the reference of slip and onset."""
        self._rearm = True
        if self._trouble:
            self._trouble.rearmed(self._cell.pose[2])

    def learn_open(self, frame: TactileFrame) -> str:
        """Take the gel at rest as the unloaded reference."""
        self._home = self._tracked(np.zeros_like(self._cell.state.gel[self._index]), frame, 8)
        self._open.learn(self._home)
        return ""

    def explain(self, frame: TactileFrame) -> str:  # noqa: ARG002
        """No gel is refused here."""
        return ""

    def forget_open(self) -> None:
        """What was learnt as the open gel was none."""
        self._home, self._open = None, OpenGel()

    def observe(self, frame: TactileFrame) -> Observation:
        """Perceive the moment at which the frame was taken."""
        field = self._field(frame)
        onset_ns = None
        if self._rearm:
            slip = self._slip.rearm(field)
            self._onset.rearm(field)
            self._rearm = False
        else:
            slip, onset_ns = self._slip.update(field), self._onset.update(field)
        picture = cast("NDArray[np.uint8]", LatePicture(self._cell.picture_later(self._index), self._rectifier))
        stamps, touch = (frame.seq, frame.captured_ns), self._touch(field, picture)
        observation = Observation(self._finger, *stamps, picture, field, slip, onset_ns, {})
        bulge, weight = self._open.bulge(field), self._open.weight(field)
        certain_ns = self._last_ns if self._trouble and self._trouble.doubted else frame.captured_ns
        self._last_ns = frame.captured_ns
        return dataclasses.replace(observation, bulge=bulge, touch=touch, weight=weight, certain_ns=certain_ns)

    def _touch(self, field: MarkerField, picture: NDArray[np.uint8]) -> float | None:
        """How much the gel is touched; only a grip that moves no marker takes a picture to be seen."""
        bulge = self._open.bulge(field)
        if bulge is None or bulge >= 1.0 or (self._trouble and self._trouble.struck):
            return bulge
        if self._home is not None:
            self._open.learn(self._home, shrunk(self._rectifier.apply(self._cell.open_picture(self._index))))
            self._home = None
        return self._open.touch(field, shrunk(np.asarray(picture)))

    def _field(self, frame: TactileFrame) -> MarkerField:
        """The field of a frame: the cell's gel, or a fault's version of it."""
        trouble = self._trouble
        if trouble is None or not trouble.strikes(self._cell.pose[2]):
            self._gel = self._exposed()
            return self._tracked(self._gel, frame, 7)
        if trouble.fault.kind == "dark":
            return empty_field(frame.captured_ns, "lost", "no marker was found")
        if self._gel is None:
            self._gel = np.zeros_like(self._cell.gels(self._index)[0])  # the gel has not moved since the hand was open
        trouble.copies += 1
        return trouble.marked(self._tracked(np.zeros_like(self._gel) if trouble.gone else self._gel, frame, 7))

    def _tracked(self, gel: NDArray[np.floating], frame: TactileFrame, what: int) -> MarkerField:
        """The field of a gel state plus the tracker's error, which is seeded by ``what`` and the frame."""
        cell = self._cell
        field = field_from_gel(gel[..., :3], frame.captured_ns, cell.scene.sensor)
        rng = np.random.default_rng(hash_seed(cell.seed, cell.frame, self._index, what))
        error = rng.normal(0.0, self._error_px, field.displacement_px.shape).astype(np.float32)
        return dataclasses.replace(field, displacement_px=field.displacement_px + error, contact=None)

    def _exposed(self) -> NDArray[np.floating]:
        """The gel as a picture shows it: a smeared marker is found at the middle of its path during the exposure."""
        view, (now, before) = self._cell.view(self._index), self._cell.gels(self._index)
        late = np.float32(0.5 * view.blur_share)
        exposed: NDArray[np.floating] = now - late * (now - before)
        unstated = self._cell.unstated
        if unstated.mirrored[self._index]:
            exposed = exposed[:, ::-1].copy()
            exposed[..., 0] *= -1.0
        if (unstated.camera_scale[self._index], unstated.camera_roll_deg[self._index]) != (1.0, 0.0):
            exposed = exposed.copy()
            exposed[..., :2] = exposed[..., :2] @ unstated.turned_and_scaled(self._index).T
        return exposed
