"""Whether a gel is touched, told by comparison with the same gel open: its markers and the light between them.

A pressed gel carries its markers along and changes colour where its surface tilts. Either alone fails: a thin or light
object moves no marker, a flat one shades little. Marker by marker and cell by cell, the worst few decide, so that a
touch at the gel's edge is a touch, and a speck of dirt is none.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField

Float64 = NDArray[np.float64]
_SPOT = 0.35  # pitch; side of the square whose mean colour stands for a cell between four markers
_DARKEST = 8.0  # grey levels; below, a cell's colour says nothing
_LEAST_CELLS = 9
_EXPOSED = 1.3  # times the open gel's light; beyond, the camera is still finding its exposure


@dataclass(frozen=True, slots=True)
class OpenGelSettings:
    """A gel is touched from these on: markers ``bulge_pitch`` off (RMS), or ``shade_grey`` levels in some cells.

    Both hold for the mean over the ``worst`` share of markers or cells, but for ``broken`` of the markers.
    """

    bulge_pitch: float = 0.045
    shade_grey: float = 5.0
    worst: float = 0.15
    broken: float = 0.05


class OpenGel:
    """How far one finger's picture is from that of its open gel, learnt before the grasp."""

    def __init__(self, settings: OpenGelSettings | None = None) -> None:
        self.settings = settings or OpenGelSettings()
        self._field: MarkerField | None = None
        self._colours: Float64 = np.zeros((0, 0, 3))

    @property
    def known(self) -> bool:
        """True once the open gel was learnt."""
        return self._field is not None

    def learn(self, image: NDArray[np.uint8], field: MarkerField) -> None:
        """Take this frame, uint8 [h, w, 3], for the open gel. Raises ValueError if it shows no markers."""
        if not field.usable:
            raise ValueError(f"an open gel cannot be learnt from a frame without markers: {field.reason}")
        self.learn_colours(cell_colours(image, field), field)

    def learn_colours(self, colours: Float64, field: MarkerField) -> None:
        """As :meth:`learn`, from the :func:`cell_colours` of a usable frame."""
        self._field, self._colours = field, colours

    def touch(self, image: NDArray[np.uint8], field: MarkerField) -> float | None:
        """How strongly the gel is touched, touched from 1 on; None where the frame or the open gel is not known."""
        return None if not self.known or not field.usable else self.compare(cell_colours(image, field), field)

    def compare(self, colours: Float64, field: MarkerField) -> float | None:
        """As :meth:`touch`, from the :func:`cell_colours` of a frame."""
        home = self._field
        if home is None or field.valid.shape != home.valid.shape:
            return None
        may = field.valid & home.valid
        lit = self._colours.min(-1) > _DARKEST
        if may.sum() < _LEAST_CELLS or lit.sum() < _LEAST_CELLS:
            return None
        off = (field.rest_px + field.displacement_px - home.rest_px - home.displacement_px)[may]
        far = np.sort(np.linalg.norm(off, axis=-1))[: max(1, int((1 - self.settings.broken) * may.sum()))]
        bulge = _worst(far, self.settings.worst) / field.pitch_px
        # Exposure changes all cells alike: its factor is the median over cells and colours.
        gain = float(np.median(colours[lit] / self._colours[lit]))
        if not 1 / _EXPOSED < gain < _EXPOSED:
            return None
        shade = _worst(np.sort(np.abs(colours / gain - self._colours)[lit].max(-1)), self.settings.worst)
        return max(bulge / self.settings.bulge_pitch, shade / self.settings.shade_grey)


def cell_colours(image: NDArray[np.uint8], field: MarkerField) -> Float64:
    """Mean colour [rows - 1, columns - 1, 3] midway between each four markers, where they are now; 0 .. 255."""
    places = (field.rest_px + field.displacement_px).astype(np.float64)
    middle = (places[:-1, :-1] + places[1:, :-1] + places[:-1, 1:] + places[1:, 1:]) / 4
    side = max(3, round(_SPOT * field.pitch_px) | 1)
    height, width = image.shape[:2]
    column = np.clip(np.rint(middle[..., 0]), 0, width - 1).astype(np.intp)
    row = np.clip(np.rint(middle[..., 1]), 0, height - 1).astype(np.intp)
    picture = image if image.ndim == 3 else np.repeat(image[..., None], 3, -1)
    return np.asarray(cv2.blur(picture, (side, side))[row, column], np.float64)


def _worst(ranked: Float64, share: float) -> float:
    """Mean of the largest ``share`` of ranked values, at least three."""
    return float(ranked[-max(3, int(share * ranked.size)) :].mean())
