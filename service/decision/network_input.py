"""A network's input from frames: rectified pictures, tracked marker fields, or steps of depth.

Steps of depth (`service.perception.pressing`) are fed as they are completed. The decision is complete after the card's
last step, or with the available steps once the arm was ordered to stop: the depth of later frames is unknown.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import ModelCard
from service.contract.model_card import MARKER_PITCH, Lattice
from service.decision.evidence import Refusal, paused
from service.perception.markers.field import MarkerField, marker_array
from service.perception.observation import PairObservation
from service.perception.pressing import DepthSteps, Legs, lattice_weights, on_lattice
from service.perception.turning import both_deg, carried_rad

Floats = NDArray[np.float32]
FELT, FELT_BY_N = 0.1, 10  # a press moves so many lattice points by this share of itself; a sag moves fewer
TURNED_DEG = 0.1  # or it turns the object by more; sags turn it by 0.03 deg at most, see docs/decisions/0079
UNTIL_SLIP_N = 20  # steps of a press until slip, at most
REACHES, FEWEST_N = 2.0, 4  # presses of an attempt: at most so many shear reaches, if known, but at least so many steps


def network_pair(card: ModelCard, pair: PairObservation) -> NDArray[Any]:
    """A pair as input of the card's graph, left finger first; raise Refusal if its grid is not the card's."""
    if card.markers is None:
        return pair.pixels()
    try:
        return np.stack([marker_array(finger.field, card.markers) for finger in pair.fingers])
    except ValueError as error:
        raise Refusal("out_of_distribution", str(error)) from error


def check_trained(card: ModelCard, conditions: Mapping[str, float | None], pairs: Sequence[PairObservation]) -> None:
    """Raise Refusal if a condition, or a marker pitch in ``pairs``, is outside the networks' training range."""
    pitches_mm: list[float | None] = [
        finger.field.pitch_px * card.profile.mm_per_px for pair in pairs for finger in pair.fingers
    ]
    for pitch_mm in pitches_mm or [None]:  # without pairs, the conditions alone
        if why := card.pressing.outside({**conditions, MARKER_PITCH: pitch_mm}) if card.pressing else "":
            raise Refusal("out_of_distribution", why)


def shows_press(moved_mm: Floats, press_mm: float, lattice: Lattice) -> bool:
    """Whether motion [2, rows, columns, 3] of both fingers over ``press_mm`` shows a press, and not a sag.

    A press moves the markers by a share of itself. In a small contact it moves few of them, but turns the object.
    """
    by_mm = np.sort(np.hypot(moved_mm[..., 0], moved_mm[..., 1]), axis=None)
    if by_mm[-FELT_BY_N] >= FELT * press_mm:
        return True
    place_mm = lattice.points_mm.reshape(-1, 2)
    left_rad, right_rad = (carried_rad(place_mm, finger[..., :2].reshape(-1, 2)) for finger in moved_mm)
    return abs(both_deg(left_rad, right_rad)) > TURNED_DEG


@dataclass(slots=True)
class PressedFinger:
    """One finger's fields on the lattice; its weights are those of the first grid it showed."""

    lattice: Lattice
    mm_per_px: float
    centre_px: Floats
    _weights: Floats | None = None

    def read(self, field_px: MarkerField) -> Floats:
        """[rows, columns, 3] in mm since the tracker's first frame; raise Refusal where there is no such grid."""
        valid = field_px.valid.ravel()
        if self._weights is None:
            if not valid.size:
                raise Refusal("out_of_distribution", f"no marker grid was found: {field_px.reason or field_px.status}")
            rest_mm = (field_px.rest_px.reshape(-1, 2) - self.centre_px) * self.mm_per_px
            self._weights = lattice_weights(rest_mm, self.lattice, field_px.pitch_px * self.mm_per_px)
        if valid.size != self._weights.shape[1]:
            raise Refusal("out_of_distribution", f"the grid changed to {field_px.valid.shape} markers")
        moved_mm = field_px.displacement_px.reshape(-1, 2) * np.float32(self.mm_per_px)
        return on_lattice(moved_mm, valid, self._weights).reshape(self.lattice.rows, self.lattice.columns, 3)


def _readable(pair: PairObservation) -> bool:
    """Whether both fingers show the gel of that moment; between such pairs its motion is taken to be linear."""
    return all(finger.field.usable for finger in pair.fingers)


@dataclass(slots=True)
class Descent:
    """The steps of depth of one attempt. ``speed_mm_s`` None: not stated by the client, so no depth is known.

    ``press_mm``: length of the press. ``legs``: how the arm descends. ``until_slip``: press on after the last step that
    the networks read.
    """

    card: ModelCard
    conditions: dict[str, float | None]
    press_mm: float
    legs: Legs = field(default_factory=Legs)
    until_slip: bool = False
    problem: Refusal | None = None
    _steps: DepthSteps | None = None
    _last: Floats | None = None
    _fingers: tuple[PressedFinger, ...] = field(init=False)

    def __post_init__(self) -> None:
        assert self.card.pressing is not None
        frame, mm_per_px = self.card.frame, self.card.profile.mm_per_px
        centre = np.array([0.5 * (frame.width_px - 1), 0.5 * (frame.height_px - 1)], np.float32)
        self._fingers = tuple(PressedFinger(self.card.pressing.lattice, mm_per_px, centre) for _ in range(2))

    @property
    def enough(self) -> bool:
        """Whether the object was pressed deep enough for the decision."""
        return self._steps is not None and self._steps.steps_n >= self.worth_n

    @property
    def felt(self) -> bool:
        """Whether the steps show a press on something, and not a heavy object that sags."""
        steps = self._steps
        if steps is None or self._last is None:
            return False
        return shows_press(self._last, steps.steps_n * steps.spec.step_mm, steps.spec.lattice)

    @property
    def worth_n(self) -> int:
        """Number of steps to press, fewer where the gel slides earlier: a turn made while sliding is permanent."""
        spec, reach_mm = self.card.pressing, self.conditions.get("shear_reach_mm")
        assert spec is not None
        if self.until_slip:
            return UNTIL_SLIP_N
        press_mm = min(self.press_mm, REACHES * reach_mm) if reach_mm else self.press_mm
        return min(spec.steps_n, max(FEWEST_N, round(press_mm / spec.step_mm)))

    @property
    def pressed_mm(self) -> float:
        """Length of the press since the onset, mm."""
        return 0.0 if self._steps is None else self._steps.pressed_mm

    def pressed_at_mm(self, stamp_ns: int) -> float | None:
        """Length of the press since the onset at that stamp, mm; None where the onset is not known."""
        return None if self._steps is None else self._steps.pressed_at_mm(stamp_ns)

    def begin(self, pairs: list[PairObservation], first: int) -> list[Floats]:
        """Take the pairs so far, ``first`` being the first to show motion; returns the completed steps."""
        try:
            self._check(pairs)
            spec = self.card.pressing
            assert spec is not None
            longest_n = max(spec.steps_n, self.worth_n)
            self._steps = DepthSteps(spec.model_copy(update={"steps_n": longest_n}), self.legs)
            at_rest = [pair for pair in pairs[:first] if _readable(pair)]
            moving = [pair for pair in pairs[first:] if _readable(pair)]
            if not at_rest:  # then what a finger never showed at rest stays hidden
                at_rest, moving = pairs[:first], pairs[first:]
            kept = [*at_rest, *moving]
            self._steps.begin([pair.captured_ns for pair in kept], [self._read(pair) for pair in kept], len(at_rest))
            return self._fresh()
        except Refusal as refusal:
            self.problem = refusal
            return []

    def add(self, pair: PairObservation) -> list[Floats]:
        if self._steps is None or self.problem or not _readable(pair):
            return []
        try:
            self._steps.add(pair.captured_ns, self._read(pair))
            return self._fresh()
        except Refusal as refusal:
            self.problem = refusal
            return []

    def _fresh(self) -> list[Floats]:
        assert self._steps is not None
        fresh = self._steps.fresh()
        self._last = fresh[-1] if fresh else self._last
        return fresh

    def _read(self, pair: PairObservation) -> Floats:
        return np.stack([finger.read(one.field) for finger, one in zip(self._fingers, pair.fingers, strict=True)])

    def _check(self, pairs: list[PairObservation]) -> None:
        """Estimate conditions from the frames, and raise Refusal outside the networks' training range."""
        if (speed_mm_s := self.conditions.get("speed_mm_s")) == 0.0:
            raise paused()
        if speed_mm_s is None:
            detail = "these networks read depth: expected `descending` with speed_mm_s"
            raise Refusal("out_of_distribution", detail)
        stamps_ns = np.array([pair.captured_ns for pair in pairs], np.float64)
        if len(stamps_ns) > 1:
            period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
            self.conditions["frame_spacing_mm"] = period_s * speed_mm_s
        check_trained(self.card, self.conditions, pairs[-1:])
