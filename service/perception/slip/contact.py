"""Whether anything touches the gel, from its markers alone: pressed rubber bulges and carries its markers along.

While nothing moves it is unknown which markers lie under the object. But a gel that nothing presses is recognisable:
its markers are where they were printed. A frame of the untouched gel gives those places exactly (`FreeGel.learn`);
without one, the regularity of the print does, on a sensor whose rectified image shows a regular grid. A sensor whose
lens bends its grid is then never called free, and slip is detected as if something were held.
"""

from dataclasses import dataclass, replace

import numpy as np

from service.perception.markers.field import MarkerField
from service.perception.slip.rigid import Float64

_KEPT = 0.95  # share of the markers that count: the worst few may be worn, broken or mistaken


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """Nothing touches the gel where its markers lie within this of their places, RMS in shares of the pitch.

    ``home_pitch`` holds against a learnt frame (real gels come home to 0.016, a flat object held with 2 N moves them by
    0.02), ``print_pitch`` against a regular grid of unknown place, size and turn, which a press from 8 N on leaves.
    ``valid_share``: of the markers, below which the contact stays unknown.
    """

    home_pitch: float = 0.018
    print_pitch: float = 0.012
    valid_share: float = 0.6


class FreeGel:
    """Marks the fields of one finger that show an untouched gel."""

    def __init__(self, settings: ContactSettings | None = None) -> None:
        self.settings = settings or ContactSettings()
        self._home: MarkerField | None = None

    def learn(self, field: MarkerField) -> None:
        """Take ``field`` as that of a gel that nothing touches. Raises ValueError if it shows no markers."""
        if not field.usable:
            raise ValueError(f"an untouched gel cannot be learnt from a frame without markers: {field.reason}")
        self._home = field

    def mark(self, field: MarkerField) -> MarkerField:
        """The field with an empty contact if nothing touches the gel, else as it is (its contact is not known)."""
        if field.contact is not None:
            return field
        bulge = self.bulge(field)
        if bulge is None or bulge >= 1:
            return field
        return replace(field, contact=np.zeros_like(field.valid))

    def bulge(self, field: MarkerField) -> float | None:
        """How far the markers are from their places, RMS, in shares of what an untouched gel may show; None: unseen."""
        if not field.usable:
            return None
        may = field.valid
        home = self._home
        if home is not None:
            if home.valid.shape != may.shape:
                return None
            may = may & home.valid
        if may.sum() < max(12, self.settings.valid_share * may.size):
            return None
        now = (field.rest_px + field.displacement_px)[may].astype(np.float64)
        if home is None:
            off, limit = _off_print(np.argwhere(may).astype(np.float64), now), self.settings.print_pitch
        else:
            off, limit = now - (home.rest_px + home.displacement_px)[may], self.settings.home_pitch
        return _spread(off) / (limit * field.pitch_px)


def _off_print(cells: Float64, points: Float64) -> Float64:
    """How far points [n, 2] lie from the regular grid that fits them best, px; ``cells`` [n, 2]: row and column."""
    terms = np.column_stack([cells, np.ones(len(cells))])
    fit, _, _, _ = np.linalg.lstsq(terms, points, rcond=None)
    return np.asarray(points - terms @ fit)


def _spread(off: Float64) -> float:
    """RMS length of the deviations [n, 2], but for the worst few."""
    squared = np.sort(np.square(off).sum(-1))
    return float(np.sqrt(squared[: max(1, int(_KEPT * len(squared)))].mean()))
