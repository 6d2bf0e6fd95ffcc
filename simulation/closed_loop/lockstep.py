"""Arm and cameras of the simulated cell in lock step: time advances by one frame at a time, as fast as it computes.

Nothing here decides. A stop takes effect after the controller's lag, so overtravel is part of every attempt.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS, FramePair, TactileFrame
from service.perception.rectification import CameraCalibration
from simulation.closed_loop.cameras import Camera, own_cameras
from simulation.closed_loop.job import Course
from simulation.physics.inertia import INSTANT_S
from simulation.physics.inertia import duration_s as time_at
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.effects import dropped_share
from simulation.scene.scene import Scene
from simulation.scene.state import Cell, CellState, PhysicsError
from simulation.scene.unstated import Misplacement, Pose, Unstated

START_NS = 1_000_000_000
CREEP_ALLOWANCE_MM = 4.0  # extra depth a client may use for a part pushed up in the hand: the gap here has no floor
MAX_UNSOLVED = 6  # consecutive moves without an equilibrium before the cell is lost and the insertion void
Image = NDArray[np.uint8]
Walk = Callable[[float], float]
"""Travel of a descent in mm after a time in s."""
_ROUNDING_MM, _ROUNDING_DEG = 1e-6, 1e-9


class GraspEndError(Exception):
    """The object left the grasp as far as it is simulated: the gel states from here on are unknown."""


@dataclass(slots=True)
class LockstepCell:
    """Scene, hand and cameras with one clock. Poses are the TCP's, mm and deg, in the work-object frame.

    Poses are the reported ones, see `unstated`; the object's error and its depth are true. With ``draws`` False frames
    carry no picture (uint8 [0, 0, 3]), for perception that reads the gel itself. A camera with latency shows the gel at
    that much earlier a time, stamped when the frame arrives; after a travel it shows the gel at rest from the first
    frame. ``still_s``: time since the end of a descent.
    """

    scene: Scene
    physics: Cell
    cameras: tuple[Camera, Camera]
    misplaced: Misplacement
    seed: int
    draws: bool = True
    now_ns: int = START_NS
    frame: int = 0
    bottom_z_mm: float = math.inf
    moving: bool = False
    still_s: float = 0.0
    state: CellState = field(init=False)
    shots: deque[tuple[CellState, float]] = field(init=False)  # exposures, with the TCP's height in mm
    course: Course = field(default_factory=Course)
    speed_mm_s: float = field(init=False)
    stands_s: float = math.inf  # from then on a descent stands, its lease being over
    _stuck: int = 0
    _law: Walk | None = None
    _walked_s: float = 0.0

    def __post_init__(self) -> None:
        self.state = self.physics.look()
        self.speed_mm_s = self.scene.speed_mm_s
        self.shots = deque(maxlen=2 + math.floor(self._late_periods))
        self._rest()

    @classmethod
    def build(
        cls,
        scene: Scene,
        x_mm: float,
        theta_deg: float,
        seed: int,
        *,
        unstated: Unstated | None = None,
        draws: bool = True,
        make: Callable[[Scene, int], Cell] = QuasiStaticCell,
        cameras: Callable[[Scene, int], tuple[Camera, Camera]] = own_cameras,
    ) -> "LockstepCell":
        """A cell with the object grasped, commanded to the start error at approach height; ``make``: mechanics."""
        cell = make(scene, seed)
        cell.regrasp(x_mm, theta_deg)
        misplaced = Misplacement(unstated or Unstated(), _pose_of(cell))
        x, y, z, yaw = misplaced.true(misplaced.approach)
        if not misplaced.unstated.well_placed:
            cell.move_to(x, y, misplaced.approach[2], yaw)
            cell.move_to(x, y, z, yaw)
        return cls(scene, cell, cameras(scene, seed), misplaced, seed, draws)

    @property
    def unstated(self) -> Unstated:
        return self.misplaced.unstated

    @property
    def now_s(self) -> float:
        return self.now_ns / 1e9

    @property
    def pose(self) -> tuple[float, float, float, float]:
        """TCP x, y, z in mm and yaw in deg, as the arm reports it."""
        return self.misplaced.reported(_pose_of(self.physics))

    @property
    def tilt_deg(self) -> float:
        return math.degrees(self.physics.tilt_rad)

    def travel(
        self, x_mm: float, y_mm: float, z_mm: float, yaw_deg: float, duration_s: float, *, tilt_deg: float = 0.0
    ) -> None:
        """Tilt the tool, then move there in a straight line; no frame is taken on the way. Raises PhysicsError."""
        if abs(tilt_deg - self.tilt_deg) > _ROUNDING_DEG:
            self.physics.tilt_to(tilt_deg)
        target = self.misplaced.true((x_mm, y_mm, z_mm, yaw_deg))
        way = np.subtract(target, _pose_of(self.physics)) * (1.0, 1.0, 1.0, math.radians(1.0))
        self.physics.pace_mm_s = max(time_at(way, 1.0) / max(duration_s, 1e-3), 1e-3)
        while not self._go(*target):
            pass
        self.physics.pace_mm_s = self.speed_mm_s
        self._rest()
        self.now_ns += round(duration_s * 1e9)

    def take_afresh(self, x_mm: float, y_mm: float, yaw_deg: float, duration_s: float) -> None:
        """Put the object back into its fixture, regrasp it upright and return above that place. Raises PhysicsError."""
        self.physics.regrasp(0.0, 0.0)
        self.state = self.physics.look()
        self.travel(x_mm, y_mm, self.misplaced.approach[2], yaw_deg, duration_s)

    def descend(self, bottom_z_mm: float, law: Walk | None = None) -> None:
        """Begin a descent at the scene's speed, or by ``law``; every `next_pair` shows the result.

        Raises GraspEndError if an earlier descent pushed the object out of its grasp.
        """
        if self.state.grasp_lost:
            raise GraspEndError("the fingers do not hold the object: it was pushed 12 mm, or turned away")
        self.bottom_z_mm, self.moving, self._law, self._walked_s, self.still_s = bottom_z_mm, True, law, 0.0, 0.0

    def hold(self) -> None:
        """Order a stop: it takes effect after the controller's lag, of which a target that stood has used up some."""
        if self.moving:
            lag_s = min(self.unstated.stop_lag_s, max(0.0, self.stands_s - self.now_s))
            self.bottom_z_mm = max(self.bottom_z_mm, self.pose[2] - self._ahead_mm(lag_s))

    def next_pair(self, *, look: bool = True) -> FramePair:
        """Advance one frame period and take both fingers' frames, drawn only with ``look``.

        Raises PhysicsError when the cell is lost for good.
        """
        began_s = self.now_s
        self.now_ns += round(1e9 / self.scene.fps)
        after = self._late_periods % 1.0  # in periods, from an exposure to the next arrival of a frame
        self._pass(began_s, 1.0 - after)
        self.shots.append((self.state, self.pose[2]))
        if after > 0.0:
            self._pass(began_s + (1.0 - after) / self.scene.fps, after)
        self.frame += 1
        left, right = (
            TactileFrame(
                finger, self.frame, self.now_ns, self.picture_later(index)() if self.draws and look else _NOTHING
            )
            for index, finger in enumerate(FINGERS)
        )
        return FramePair(left, right)

    def open_pair(self) -> FramePair:
        """Both fingers' frames of this moment as they would be with nothing between the fingers; takes no time."""
        pictures = (self.open_picture(index) if self.draws else _NOTHING for index in range(len(FINGERS)))
        left, right = (
            TactileFrame(finger, self.frame, self.now_ns, picture)
            for finger, picture in zip(FINGERS, pictures, strict=True)
        )
        return FramePair(left, right)

    def arrived(self) -> tuple[bool, bool]:
        """Whether each of the last two frames reached the service: cameras drop a share of them independently."""
        if (share := dropped_share(self.scene)) <= 0.0:
            return True, True
        lost = np.random.default_rng(hash_seed(self.seed, self.frame, 99)).random(2) < share
        return not lost[0], not lost[1]

    @property
    def _late_periods(self) -> float:
        return self.scene.camera.latency_ms * 1e-3 * self.scene.fps

    def _rest(self) -> None:
        """All frames still to come show the present gel."""
        self.shots.extend([(self.state, self.pose[2])] * (self.shots.maxlen or 0))

    def _pass(self, from_s: float, periods: float) -> None:
        """Advance from that time by a fraction of a frame period."""
        passed_s = periods / self.scene.fps
        goes_s = min(passed_s, max(0.0, self.stands_s - from_s)) if self.moving else 0.0
        pauses_s = passed_s - goes_s
        if goes_s > 0.0:
            x, y, z, yaw = _pose_of(self.physics)
            bottom, way_mm = self.misplaced.true((0.0, 0.0, self.bottom_z_mm, 0.0))[2], self._way_mm(goes_s)
            target = max(bottom, z - way_mm)
            if self._go(x, y, target, yaw):
                self.moving = target - bottom > (_ROUNDING_MM if self._law else 0.0)
                self._walked_s += goes_s
                if not self.moving:  # it stood before the period was over
                    pauses_s += goes_s * (1.0 - (z - target) / max(way_mm, _ROUNDING_MM))
                self.still_s = 0.0 if self.moving else pauses_s
        else:
            self.still_s += passed_s
        if pauses_s > INSTANT_S and self.physics.relaxes:
            self._do(lambda: self.physics.wait(pauses_s))

    def _way_mm(self, passed_s: float) -> float:
        """Downward travel of the arm in that time."""
        way_mm = self._ahead_mm(passed_s)
        if self._law is not None:
            self.physics.pace_mm_s = max(way_mm / passed_s, 1e-3)
        return way_mm

    def _ahead_mm(self, passed_s: float) -> float:
        law, walked_s = self._law, self._walked_s
        return law(walked_s + passed_s) - law(walked_s) if law else self.speed_mm_s * passed_s

    def _finger_at(self, index: int) -> int:
        """Index of the finger seen by the camera called ``index`` (0 left, 1 right)."""
        return 1 - index if self.unstated.swapped_fingers else index

    def view(self, index: int) -> Camera:
        """The camera that draws the frames under a finger's name."""
        return self.cameras[self._finger_at(index)]

    def gels(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The gel in the last frame of that name, and in the frame before it."""
        finger = self._finger_at(index)
        return self.shots[1][0].gel[finger], self.shots[0][0].gel[finger]

    @property
    def exposed_mm(self) -> float:
        """Height of the TCP at the exposure of the last frames, mm: before their stamp, if the camera has latency."""
        return self.shots[1][1]

    def calibration(self, index: int) -> CameraCalibration:
        """The calibration that the software uses for that camera."""
        exact = self.view(index).calibration
        centre = 0.5 * (exact.rectified.width_px - 1), 0.5 * (exact.rectified.height_px - 1)
        wrong = self.unstated.residual_px(index, centre)
        return exact if wrong is None else dataclasses.replace(exact, homography=wrong @ exact.homography)

    def picture_later(self, index: int) -> Callable[[], Image]:
        """A finger's raw frame of this moment, drawn on request with the same bits as now."""
        (gel, before), seed, camera = self.gels(index), hash_seed(self.seed, self.frame, index), self.view(index)
        return lambda: self._delivered(index, camera.raw(gel, seed, before))

    def open_picture(self, index: int) -> Image:
        """A finger's raw frame as it would be with nothing between the fingers."""
        gel = np.zeros_like(self.state.gel[index])
        return self._delivered(index, self.view(index).raw(gel, hash_seed(self.seed, 0, index, 3)))

    def _delivered(self, index: int, raw: Image) -> Image:
        """A raw frame as that camera delivers it."""
        return np.ascontiguousarray(raw[:, ::-1]) if self.unstated.mirrored[index] else raw

    def _go(self, x_mm: float, y_mm: float, z_mm: float, yaw_deg: float) -> bool:
        """Advance; False where no equilibrium was found: the arm then lags by a part of the move."""
        return self._do(lambda: self.physics.move_to(x_mm, y_mm, z_mm, yaw_deg))

    def _do(self, motion: Callable[[], CellState]) -> bool:
        try:
            state = motion()
        except PhysicsError:
            self._stuck += 1
            if self._stuck > MAX_UNSOLVED:
                raise
            return False
        self._stuck, self.state = 0, state
        self.course.take_in(state, self.physics.scene.blocks)
        return True


def _pose_of(physics: Cell) -> Pose:
    x, y, z, yaw = map(float, physics.pose)
    return x, y, z, math.degrees(yaw)


_NOTHING: Image = np.zeros((0, 0, 3), np.uint8)


def hash_seed(*parts: int) -> int:
    """One seed from several numbers, the same on every machine."""
    return int(np.random.SeedSequence(parts).generate_state(1)[0])
