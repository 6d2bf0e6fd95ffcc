"""The cameras of a cell in lock step: ours, or those of the foreign cell."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS
from service.perception.rectification import CameraCalibration
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.effects import active_effects
from simulation.scene.scene import Scene


class Camera(Protocol):
    """Draws raw frames, uint8 [h, w, 3] BGR, of one finger's gel state [rows, columns, values]."""

    @property
    def calibration(self) -> CameraCalibration:
        """Its exact calibration."""

    @property
    def blur_share(self) -> float:
        """Exposure time over frame period."""

    def raw(
        self, gel: NDArray[np.floating], frame_seed: int, previous: NDArray[np.floating] | None = None, /
    ) -> NDArray[np.uint8]:
        """A frame of ``gel``; ``previous`` is its state one frame earlier. The same seed gives the same bits."""


def own_cameras(scene: Scene, seed: int) -> tuple[Camera, Camera]:
    """Cameras of both fingers, drawn by `simulation.optics`."""
    left, right = (Renderer(Appearance.draw(scene, finger, seed)) for finger in FINGERS)
    return left, right


def foreign_cameras(scene: Scene, seed: int) -> tuple[Camera, Camera]:
    """Cameras of both fingers in the cell of finite elements."""
    from simulation.foreign import pictures

    camera, active = scene.camera, active_effects(scene)
    left, right = (
        pictures.Camera(
            scene.sensor,
            2 * seed + index,  # insertions are numbered one after the other
            noise_grey=camera.noise_grey if active.camera_noise else 0.0,
            light=camera.exposure * camera.light,
            blur_share=camera.exposure_ms * scene.fps / 1000 if active.motion_blur else 0.0,
        )
        for index in range(len(FINGERS))
    )
    return left, right
