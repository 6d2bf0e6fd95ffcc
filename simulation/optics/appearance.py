"""Appearance of one finger of one cell: all numbers of its optics, drawn once, stored with the data, read exactly."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from service.contract import FINGERS, Finger, Sensor
from simulation.scene.scene import Scene

# Name of the held surface in a scene -> (relief pattern, period in px, gain)
OBJECT_TEXTURES = {
    "smooth": ("smooth", 5.0, 0.05),
    "paper": ("smooth", 3.0, 0.09),
    "ribbed": ("ribs", 14.0, 0.10),
    "label": ("print", 12.0, 0.07),
    "layers": ("layers", 5.0, 0.07),
}


@dataclass(frozen=True, slots=True)
class Appearance:
    """Optics of one finger. Lengths in rectified px unless the name says otherwise; light as a fraction of full scale.

    ``corners_raw_px`` are those of the sensor's profile, displaced by the mounting of the camera.
    """

    finger: Finger = "left"
    seed: int = 0
    sensor: Sensor = field(default_factory=Sensor.load)
    corners_raw_px: tuple[tuple[float, float], ...] = ()
    noise_sigma_grey: float = 4.0
    exposure: float = 1.0
    light_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)
    light_shift: float = 0.0
    ambient: float = 0.12
    shading_gain: float = 1.0
    reference_pressure_n_per_mm2: float = 0.05
    cloth_period_px: float = 3.7
    cloth_contrast: float = 0.07
    worn: float = 0.5
    dot_darkness: float = 0.78
    missing_dots_share: float = 0.005
    object_texture: str = "smooth"
    object_texture_period_px: float = 5.0
    object_texture_gain: float = 0.07
    defocus_px: float = 0.6
    motion_blur_share: float = 0.0  # exposure time over frame period
    used_share: float = 0.0  # of what a sensor that was in use shows (`simulation.optics.used`)
    rolling_share: float = 0.0  # readout time of the sensor over frame period

    def __post_init__(self) -> None:
        if not self.corners_raw_px:
            object.__setattr__(self, "corners_raw_px", self.sensor.corners_raw_px)

    @classmethod
    def draw(cls, scene: Scene, finger: Finger, seed: int) -> Self:
        """The appearance of ``finger`` in ``scene``; the same (scene, finger, seed) gives the same numbers.

        Values stated by the scene (sensor, noise, exposure, textures) are used unchanged; those that a maker cannot
        control (mounting, LED balance, yarn) are drawn from ``seed``.
        """
        rng = np.random.Generator(np.random.PCG64([seed, FINGERS.index(finger), 0x1A9]))
        given = optics_of(scene)
        jitter = rng.normal(0, 1.5, (4, 2)).round(3)
        nominal = scene.sensor.corners_raw_px
        corners = tuple((u + du, v + dv) for (u, v), (du, dv) in zip(nominal, jitter.tolist(), strict=True))
        drawn: dict[str, Any] = {
            "corners_raw_px": corners,
            "light_bgr": tuple(float(x) for x in rng.uniform(0.9, 1.1, 3).round(4)),
            "light_shift": round(float(rng.uniform(-0.12, 0.12)), 4),
            "cloth_period_px": round(float(rng.uniform(3.3, 4.2)), 4),
            "seed": int(rng.integers(2**31)),
        }
        return cls(finger=finger, **(drawn | given))

    def as_dict(self) -> dict[str, Any]:
        """Plain data, exact: ``from_dict(as_dict(), sensor) == self``; of the sensor it holds only the scale."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "sensor"}
        return own | {"mm_per_px": self.sensor.mm_per_px}

    @classmethod
    def from_dict(cls, data: dict[str, Any], sensor: Sensor) -> Self:
        """Inverse of :meth:`as_dict` (also after JSON).

        Raises ValueError naming unknown keys, or the scale if it belongs to another sensor.
        """
        own = {name: _as_tuples(value) for name, value in data.items() if name != "mm_per_px"}
        unknown = set(own) - {f.name for f in dataclasses.fields(cls)}
        if unknown:
            raise ValueError(f"appearance has unknown keys {sorted(unknown)}")
        if data["mm_per_px"] != sensor.mm_per_px:
            raise ValueError(f"appearance has mm_per_px {data['mm_per_px']}, sensor {sensor} {sensor.mm_per_px}")
        return cls(sensor=sensor, **own)


def _as_tuples(value: Any) -> Any:
    """Lists (JSON) to tuples (hashable), recursively."""
    return tuple(_as_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def optics_of(scene: Scene) -> dict[str, Any]:
    """The appearance fields that the scene itself fixes (see `simulation.scene.scene.Camera`, `Gel`, `HeldObject`)."""
    from simulation.scene.effects import active_effects

    camera, active = scene.camera, active_effects(scene)
    body = scene.object
    texture, period_px, gain = OBJECT_TEXTURES[body.texture]
    if body.texture_period_mm is not None:
        period_px = body.texture_period_mm / scene.sensor.mm_per_px
    if body.texture_gain is not None:
        gain = body.texture_gain
    return {
        "sensor": scene.sensor,
        "noise_sigma_grey": camera.noise_grey if active.camera_noise else 0.0,
        "exposure": camera.exposure * camera.light,
        "used_share": camera.used_share if active.used_sensor else 0.0,
        "worn": scene.gel.wear if active.gel_wear else 0.0,
        "missing_dots_share": 0.02 * scene.gel.wear if active.gel_wear else 0.0,
        "object_texture": texture,
        "object_texture_period_px": period_px,
        "object_texture_gain": gain if active.object_texture else 0.0,
        "motion_blur_share": camera.exposure_ms * scene.fps / 1000 if active.motion_blur else 0.0,
        "rolling_share": camera.readout_ms * scene.fps / 1000 if active.rolling_shutter else 0.0,
    }
