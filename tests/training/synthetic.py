"""A tiny stand-in for a collected dataset: real pictures of moving dots whose motion follows the error."""

import hashlib
from dataclasses import dataclass, field

import cv2
import numpy as np

from service.contract import Sensor

PITCH_PX, MM_PER_PX = 15.0, 0.07
ROWS, COLS, FRAMES = 20, 21, 30


def _base():
    image = np.full((320, 327, 3), 150, np.uint8)
    image[..., 1] = 170
    for v in range(ROWS):
        for u in range(COLS):
            centre = (round((13 + u * PITCH_PX) * 16), round((17 + v * PITCH_PX) * 16))
            cv2.circle(image, centre, 40, (30, 30, 30), -1, cv2.LINE_AA, 4)
    return image


BASE = _base()


@dataclass
class SyntheticTrial:
    x_mm: float
    theta_deg: float
    gel: np.ndarray
    group: int
    split: str
    object_name: str = "rectangle"
    gap_width_mm: float = 56.0
    grasp_height_mm: float = 30.0
    in_hand: np.ndarray = field(default_factory=lambda: np.zeros((30, 6), np.float32))
    onset_frame: int = 18
    stop_frame: int = 20
    outcome: str = "blocked"
    seed: int = 0
    poke: int = 0
    scene_sha256: str = "0"


def _gel(x_mm, theta_deg, onset, rng):
    """Rotation in the gel plane follows x, pressure follows theta, as in the cell; [30, 2, 20, 21, 3]."""
    v, u = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLS * 1j]
    gel = np.zeros((FRAMES, 2, ROWS, COLS, 3), np.float32)
    ramp = np.clip((np.arange(FRAMES) - onset + 1) / 8, 0, 1)[:, None, None]
    for finger, side in ((0, 1.0), (1, -1.0)):
        gel[:, finger, ..., 0] = ramp * (-side * x_mm * v * 0.03)
        gel[:, finger, ..., 1] = ramp * (side * x_mm * u * 0.03 + 0.1)
        gel[:, finger, ..., 2] = ramp * (theta_deg * u * 0.01)
    return (gel + rng.normal(0, 0.003, gel.shape)).astype(np.float16)


@dataclass
class SyntheticManifest:
    name: str = ""
    sensor: Sensor = field(default_factory=Sensor.load)

    def sha256(self):
        return hashlib.sha256(self.name.encode()).hexdigest()


@dataclass
class SyntheticSource:
    """Same interface as ``simulation.data.dataset.Dataset``."""

    count: int = 60
    seed: int = 0
    manifest: SyntheticManifest = field(default_factory=SyntheticManifest)

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        self.manifest.name = f"{self.count}-{self.seed}"
        self.trials = []
        for index in range(self.count):
            x_mm, theta_deg = rng.uniform(-15, 15, 2)
            group = index // 5
            split = ("train", "train", "train", "validation", "test")[group % 5]
            self.trials.append(
                SyntheticTrial(x_mm, theta_deg, _gel(x_mm, theta_deg, 18, rng), group, split, seed=index)
            )

    def __len__(self):
        return self.count

    def trial(self, index):
        return self.trials[index]

    def frames(self, index, start, count):
        return np.stack([[self._draw(index, frame, f) for f in (0, 1)] for frame in range(start, start + count)])

    def _draw(self, index, frame, finger):
        gel = self.trials[index].gel[frame, finger].astype(np.float64)
        noise = np.random.default_rng([self.seed, index, frame, finger])
        v, u = np.mgrid[:320, :327].astype(np.float32)
        motion = cv2.resize(gel[..., :2].astype(np.float32) / MM_PER_PX, (327, 320))
        image = cv2.remap(BASE, u - motion[..., 0], v - motion[..., 1], cv2.INTER_LINEAR, borderValue=(150, 170, 150))
        shade = cv2.resize(gel[..., 2].astype(np.float32), (327, 320)) * 60
        lit = image + shade[..., None] * np.array([0.3, 1.0, 0.3]) + noise.normal(0, 2, (320, 327, 1))
        return lit.clip(0, 255).astype(np.uint8)
