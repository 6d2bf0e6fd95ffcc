"""Tilt of the object in the hand, about the axis along which the fingers close, after each blocked attempt.

Two sources tell it. The gels show by how much an attempt has turned the object (:mod:`service.perception.turning`);
those errors add up, and how the object was picked up shows in no gel. The second source is the arm: where the tops on
both sides of the gap are level, a tilted object touches one of them earlier than the other. In a gap of 100 mm, a tilt
of 1 deg makes 0.9 mm on either side.

Both go into a Kalman filter of four numbers: the depth at which the object would touch if it were upright, its tilt,
how much lower one top is than the other, and the share of a press's turn that stays without any gel showing it. That
share is a property of the grip: in several attempts it errs to the same side. See docs/decisions/0192.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.perception.observation import PairObservation
from service.perception.turning import both_deg, hangs_turned, lasting_turn_deg

UPRIGHT_DEG = 2.0  # an object tilted by less counts as inserted
SURE = 3.0  # standard deviations by which it has to stay below: 1 in 370 is outside
PICKED_DEG = 0.5  # tilt of objects in the hand when they are picked up
READ_DEG, READ_SHARE = 0.12, 0.5  # error of a turn read from the gels: always, and of the turn
SLID_SHARE = 0.4  # and of the angle by which the arm went on after the gels had stopped following
HIDDEN_SHARE, HIDDEN_SPREAD = 0.07, 0.15  # of the turn while pressed: it stays, and no gel shows it
TOUCH_MM = 0.1  # error of the depth of a touch
CREEP_MM, CREEP_SPREAD_MM = 0.05, 0.2  # an attempt pushes the object up in the hand by this
SHOWS_DEG = 0.1  # a press that turns the object by less does not show on which side it touched
CONTRADICTS = 4.0  # a touch so many standard deviations from where it is expected
MOST_TILT_DEG = 1.5  # of the tool, whatever the client allows: what is tilted further is regrasped
LEAST_TILT_DEG = 0.15  # a smaller change of the tilt is not worth a move: the turn read from the gels errs by as much
UNSEEN = "the gels do not show whether the last attempt has turned the object in the hand"
_DEPTH, _TILT, _LEVEL, _HIDDEN = range(4)


class Touch(NamedTuple):
    """Where a blocked attempt touched: TCP below full depth, half the gap, and how level its tops are, mm."""

    depth_mm: float
    lever_mm: float
    level_mm: float


def _anything() -> NDArray[np.float64]:
    return np.diag([1e4, PICKED_DEG**2, 0.0, HIDDEN_SPREAD**2])


@dataclass(slots=True)
class HeldTilt:
    """Tilt of the object in the hand, signed as a turn in the left finger's picture, and that of the tool.

    ``tilt_deg``: of the tool about the fingers' axis; with minus the object's tilt it holds the object upright.
    ``most_tilt_deg``: how far it may be tilted. ``unknown``: why the tilt is not known, or "".
    """

    tilt_deg: float = 0.0
    most_tilt_deg: float = 0.0
    unknown: str = ""
    _mean: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, HIDDEN_SHARE]))
    _spread: NDArray[np.float64] = field(default_factory=_anything)
    _pressed: PairObservation | None = None
    _slid_deg: float = 0.0

    def held_at(self, tilt_deg: float, most_tilt_deg: float) -> "HeldTilt":
        """This object, with the tool tilted so far."""
        self.tilt_deg, self.most_tilt_deg = tilt_deg, most_tilt_deg
        return self

    def pressed(self, both: PairObservation | None, touch: Touch | None = None, slid_deg: float = 0.0) -> None:
        """An attempt was blocked, ``both`` its last pair; None if it does not show the object's turn.

        ``touch``: where it touched; None if that is unknown or the tops are not known to be level. ``slid_deg``: the
        angle by which the arm may have turned the object after the gels had stopped following it.
        """
        self._pressed, self._slid_deg = both, slid_deg
        if both is None:
            self.unknown = UNSEEN
        elif touch is not None:
            self._touched(touch, both_deg(*(finger.slip.angle_rad for finger in both.fingers)))

    def lifted(self, both: PairObservation) -> None:
        """Account for the object hanging free again; only the first pair after a blocked attempt counts."""
        if self._pressed is None:
            return
        pressed_deg = both_deg(*(finger.slip.angle_rad for finger in self._pressed.fingers))
        turned_deg, self._pressed = lasting_turn_deg(self._pressed, both), None
        self.turned(turned_deg, pressed_deg, self._slid_deg)

    def turned(self, turned_deg: float, pressed_deg: float, slid_deg: float) -> None:
        """The gels show that an attempt has turned the object by that much; NaN if they do not show it.

        ``pressed_deg``: how far they showed it turned at the end of the press. ``slid_deg``: as of :meth:`pressed`.
        """
        if not math.isfinite(turned_deg + pressed_deg):
            self.unknown = UNSEEN
            return
        hidden = np.eye(len(self._mean))
        hidden[_TILT, _HIDDEN] = pressed_deg
        self._mean, self._spread = hidden @ self._mean, hidden @ self._spread @ hidden.T
        self._mean[_DEPTH] += CREEP_MM
        self._mean[_TILT] += turned_deg
        self._spread[_DEPTH, _DEPTH] += CREEP_SPREAD_MM**2
        self._spread[_TILT, _TILT] += READ_DEG**2 + (READ_SHARE * turned_deg) ** 2 + (SLID_SHARE * slid_deg) ** 2

    @property
    def deg(self) -> float:
        """The expected tilt; NaN where it is not known."""
        return float(self._mean[_TILT]) if not self.unknown else math.nan

    @property
    def sd_deg(self) -> float:
        """Its standard deviation."""
        return math.sqrt(self._spread[_TILT, _TILT])

    @property
    def left_deg(self) -> float:
        """The part of the tilt that the tool's does not make up for."""
        return self.deg + self.tilt_deg

    def __str__(self) -> str:
        return f"tilted in the hand by about {abs(self.deg):.1f} +- {self.sd_deg:.1f} deg"

    def upright(self, more_deg: float = 0.0) -> bool:
        """Whether the object surely hangs upright enough, turned by a further ``more_deg``."""
        return abs(self.left_deg + more_deg) + SURE * self.sd_deg <= UPRIGHT_DEG

    def straightening(self) -> float | None:
        """The tilt of the tool that holds the object upright, deg; None if it does so already, or is not known."""
        wanted_deg = -self.deg
        if (
            not abs(wanted_deg) <= min(self.most_tilt_deg, MOST_TILT_DEG)
            or abs(wanted_deg - self.tilt_deg) < LEAST_TILT_DEG
        ):
            return None
        return wanted_deg

    def askew(self, both: PairObservation) -> str:
        """Why the object, hanging free, needs a regrasp before the next attempt, or ""."""
        if self.unknown:
            return self.unknown
        if not self.upright():
            return f"the object is {self}"
        shown_deg, why = hangs_turned(both)
        if not why and not self.upright(shown_deg):
            why = f"the object is {self}, and its weight turns it by {shown_deg:.1f} deg"
        return why

    def _touched(self, touch: Touch, turned_deg: float) -> None:
        """The press turned the object away from the side on which it touched: that side's top was lifting it."""
        if not abs(turned_deg) >= SHOWS_DEG:
            return
        side = math.copysign(1.0, turned_deg)
        row = np.array([1.0, math.radians(side * touch.lever_mm), side, 0.0])
        if self._spread[_LEVEL, _LEVEL] == 0.0:
            self._spread[_LEVEL, _LEVEL] = (0.5 * touch.level_mm) ** 2
        upright_mm = touch.depth_mm - row[_TILT] * self.tilt_deg
        off_mm = float(upright_mm - row @ self._mean)
        variance = float(row @ self._spread @ row) + TOUCH_MM**2
        if not off_mm**2 <= CONTRADICTS**2 * variance:
            self.unknown = f"it touched {abs(off_mm):.1f} mm from the height that its tilt predicts: that is not known"
            return
        gain = self._spread @ row / variance
        self._mean += gain * off_mm
        self._spread -= np.outer(gain, row @ self._spread)
