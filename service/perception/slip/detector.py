"""Incipient slip of one finger: which of the sticking nodes stop following the object.

After Dong, Ma, Donlon, Rodriguez (2019): a rigid motion is fitted to the sticking markers, and slip is the deviation of
markers in the contact from it. Unlike there, rotation is exact, a uniform scale may be fitted (pressing spreads
markers), the contact need not be known beforehand, and an impossible fit is "unknown".

Where the contact is not given, it is learned from the motion itself: a node belongs to it once it has followed the
object for a while. A node outside lags from the start, by a constant share of the motion (the gel is elastic there); a
node that slips follows first and then stops. The score measures that excess lag.
"""

from collections import deque

import numpy as np

from service.perception.markers.field import BoolArray, MarkerField
from service.perception.slip.rigid import MIN_NODES, Float64, Motion, carried_px, length, moving_patch, refine
from service.perception.slip.state import FingerState, SlipSettings, SlipState

__all__ = ["FingerState", "SlipDetector", "SlipSettings", "SlipState", "untouched"]


_UNEVEN = 5.0  # largest ratio of the deviations of half of a shaken, soft patch and of its steadiest quarter


class SlipDetector:
    """Compares one finger's fields with the reference taken at :meth:`rearm`, after contact was established."""

    def __init__(self, settings: SlipSettings | None = None) -> None:
        self.settings = settings or SlipSettings()
        self._reference: MarkerField | None = None
        self._last: SlipState | None = None

    @property
    def armed(self) -> bool:
        """True once a reference is held."""
        return self._reference is not None

    @property
    def reference(self) -> MarkerField | None:
        """The field from which motion is measured."""
        return self._reference

    def rearm(self, field: MarkerField) -> SlipState:
        """Take ``field`` as the reference of a firm grasp. A field without evidence disarms instead."""
        self._reference = field if field.usable and field.valid.sum() >= 4 else None
        shape = field.valid.shape
        self._stuck = np.zeros(shape, np.bool_)
        self._lagged = np.zeros(shape)  # sums of lag times motion and of motion squared: their ratio is the
        self._weight = np.zeros(shape)  # elastic share of each node, by least squares
        self._slipped = np.zeros(shape, np.bool_)
        self._motion: Motion | None = None
        self._noise: deque[tuple[int, float]] = deque()  # capture stamp and how far the core deviates, px
        self._way: list[tuple[int, float]] = []  # capture stamp and motion of the patch, px
        self._fastest = 0.0
        self._tracked_ns = field.captured_ns
        if untouched(field):
            self._reference = None
            self._last = self._plain("no_contact", field, "nothing touches the gel")
        elif self._reference is None:
            self._last = self._plain("unknown", field, f"no reference: {field.reason or field.status}")
        else:
            self._last = self._plain("hold", field, "reference taken")
        return self._last

    def update(self, field: MarkerField) -> SlipState:
        """Classify one field; never raises for its content."""
        if self._reference is None and untouched(field):
            state = self._plain("no_contact", field, "nothing touches the gel")
        elif self._reference is None or field.valid.shape != self._reference.valid.shape:
            state = self._plain("unknown", field, "not armed" if self._reference is None else "the grid changed")
        elif field.status == "duplicate" and self._last is not None:
            return self._last
        elif not field.usable:
            lost = (field.captured_ns - self._tracked_ns) * 1e-9 > self.settings.lost_after_s
            state = self._plain("lost" if lost else "unknown", field, field.reason or field.status)
        else:
            self._tracked_ns = field.captured_ns
            state = self._assess(field, self._reference)
        self._last = state
        return state

    def _assess(self, field: MarkerField, reference: MarkerField) -> SlipState:
        limits, pitch = self.settings, field.pitch_px
        before = (reference.rest_px + reference.displacement_px).astype(np.float64)
        after = (field.rest_px + field.displacement_px).astype(np.float64)
        may = field.valid & reference.valid
        if reference.contact is not None:
            may = may & reference.contact
            if field.contact is not None and field.contact.sum() < 0.3 * reference.contact.sum():
                return self._plain("release", field, f"contact area fell to {field.contact.sum()} nodes")
        elif untouched(field):
            return self._plain("release", field, "the markers are back where nothing touches the gel")
        if may.sum() < 4:
            return self._plain("unknown", field, f"{may.sum()} usable markers, expected at least 4")
        if carried_px(after - before, may) < limits.still_pitch * pitch:
            return self._plain("hold", field, "at rest")
        motion = self._fit(before, after, may, pitch)
        if motion is None:
            return self._plain("unknown", field, "the sticking markers determine no rigid motion")
        return self._weigh(field, before, after, may, motion)

    def _fit(self, before: Float64, after: Float64, may: BoolArray, pitch: float) -> Motion | None:
        """Robust motion of the sticking core, from the last one or, while none is known, from the moving patch."""
        tolerance = self.settings.tolerance_pitch * pitch
        core = may & self._stuck & ~self._slipped
        warm = self._motion is not None and int(core.sum()) >= 12
        chosen = core if warm else may & ~self._slipped
        x, y = before[chosen], after[chosen]
        everyone = np.ones(len(x))
        if warm and self._motion is not None:
            motion = self._refined(x, y, self._motion, everyone, pitch)
            if motion is not None and _followers(motion, x, y, tolerance) > 0.5:
                self._motion = motion
                return motion
        start = moving_patch(before, after, chosen, tolerance, pitch)
        # Nodes that the moving patch leaves behind are outside the contact and must not affect the fit.
        carried = start.apply(x)
        moved = np.hypot(*(carried - x).T)
        follows = np.hypot(*(carried - y).T) < tolerance + self.settings.follow_share * moved
        self._motion = self._refined(x, y, start, follows.astype(np.float64), pitch)
        return self._motion

    def _refined(self, x: Float64, y: Float64, start: Motion, base: Float64, pitch: float) -> Motion | None:
        limits = self.settings
        tolerance = limits.tolerance_pitch * pitch
        motion = refine(x, y, start, base, tolerance, pitch, scale=True)
        if motion is not None and abs(motion.scale - 1) > limits.max_scale_change:
            motion = refine(x, y, start, base, tolerance, pitch, scale=False)
        return motion

    def _weigh(
        self,
        field: MarkerField,
        before: Float64,
        after: Float64,
        may: BoolArray,
        motion: Motion,
    ) -> SlipState:
        limits, pitch = self.settings, field.pitch_px
        carried = motion.apply(before)
        residual = np.where(may[..., None], after - carried, 0.0)
        lag, moved = length(residual), length(carried - before)
        limit = max(limits.slip_pitch * pitch, limits.stand_out * self._unsteady(field, lag, moved, may))
        excess = self._excess(lag, moved, may, pitch)
        slipping = excess > limit
        known = int((self._stuck & may).sum())
        need = max(limits.min_nodes, int(np.ceil(limits.slip_share * known)))
        ranked = np.sort(excess, axis=None)
        score = float(ranked[-need] / limit) if known >= need else 0.0
        self._slipped |= slipping
        return self._state(field, motion, residual, slipping, score, known)

    def _unsteady(self, field: MarkerField, lag: Float64, moved: Float64, may: BoolArray) -> float:
        """Recent deviation of the sticking core from its motion and elastic shares, px.

        The median; if half of the core lets go at once, at most a multiple of the deviation of the steadier quarter.
        """
        core = may & self._stuck & ~self._slipped & (self._weight > 0)
        if core.sum() >= MIN_NODES:
            off = np.abs(lag[core] - self._lagged[core] / self._weight[core] * moved[core])
            best, half = np.percentile(off, [25, 50])
            self._noise.append((field.captured_ns, float(min(half, _UNEVEN * best))))
        while self._noise and field.captured_ns - self._noise[0][0] > self.settings.noise_s * 1e9:
            self._noise.popleft()
        return float(np.mean([off for _, off in self._noise])) if self._noise else 0.0

    def _excess(self, lag: Float64, moved: Float64, may: BoolArray, pitch: float) -> Float64:
        """Lag in px beyond what each node's elastic share of the motion explains, 0 outside the contact."""
        limits = self.settings
        elastic = self._lagged / np.maximum(self._weight, 1e-9)
        excess = lag - elastic * moved
        carried_far = may & (moved > limits.contact_pitch * pitch) & ~self._slipped
        joins = carried_far & ~self._stuck & (lag < limits.follow_share * moved)
        self._stuck |= joins
        early = moved < limits.learn_pitch * pitch
        steady = joins | (carried_far & self._stuck & (early | (excess < limits.learn_share * moved)))
        self._lagged += np.where(steady, lag * moved, 0)
        self._weight += np.where(steady, moved * moved, 0)
        excess = np.where(joins, 0.0, excess)
        return np.where(self._stuck & may, excess, 0.0)

    def _state(
        self, field: MarkerField, motion: Motion, residual: Float64, slipping: BoolArray, score: float, known: int
    ) -> SlipState:
        limits, pitch = self.settings, field.pitch_px
        centre = field.rest_px[self._stuck].mean(0) if self._stuck.any() else motion.pivot_px
        shift = motion.apply(np.asarray(centre, np.float64)) - centre
        far_px, angle_deg = float(np.hypot(*shift)), float(np.rad2deg(motion.angle_rad))
        beyond = far_px > limits.max_shift_pitch * pitch or abs(angle_deg) > limits.max_angle_deg
        share = slipping.sum() / max(known, 1)
        stalled = self._stalls(field, far_px, pitch)
        state: FingerState = "contact"
        reason = f"the patch moved {far_px:.1f} px and turned {angle_deg:.1f} deg"
        if score >= 1:
            state = "gross_slip" if share > limits.gross_share else "incipient_slip"
            reason = f"{slipping.sum()} of {known} nodes left the object's motion"
        elif stalled:
            state, reason = "gross_slip", f"the patch stopped after {far_px:.1f} px: the object slides"
        elif motion.scale < 1 - limits.release_scale:
            state, reason = "release", f"markers contracted by {100 * (1 - motion.scale):.1f} %"
        return SlipState(
            state=state,
            score=score,
            residual_px=residual.astype(np.float32),
            slipping=slipping,
            sticking=self._stuck & ~self._slipped,
            shift_px=(float(shift[0]), float(shift[1])),
            angle_rad=motion.angle_rad,
            scale=motion.scale,
            over_limit=beyond,
            captured_ns=field.captured_ns,
            reason=reason + ("; beyond the limit of motion" if beyond else ""),
        )

    def _stalls(self, field: MarkerField, carried: float, pitch: float) -> bool:
        """Whether the patch, carried along so far, has stopped."""
        limits = self.settings
        self._way.append((field.captured_ns, carried))
        begin_ns = field.captured_ns - int(limits.stall_s * 1e9)
        older = [k for k, (stamp_ns, _) in enumerate(self._way) if stamp_ns <= begin_ns]
        if not older:
            return False
        del self._way[: older[-1]]
        gone = carried - self._way[0][1]
        self._fastest = max(self._fastest, gone)
        return carried > limits.stall_pitch * pitch and gone < limits.stall_share * self._fastest

    def _plain(self, state: FingerState, field: MarkerField, reason: str) -> SlipState:
        nobody = np.zeros(field.valid.shape, np.bool_)
        residual = np.zeros((*field.valid.shape, 2), np.float32)
        return SlipState(state, 0.0, residual, nobody, nobody, (0.0, 0.0), 0.0, 1.0, False, field.captured_ns, reason)


def untouched(field: MarkerField) -> bool:
    """True if nothing is known to touch the gel, by the simulator's pressure or by `open_gel.OpenGel`."""
    return field.usable and field.contact is not None and not field.contact.any()


def _followers(motion: Motion, before: Float64, after: Float64, tolerance: float) -> float:
    """Share of the points that follow the motion within twice the tolerance."""
    return float((length(motion.apply(before) - after) < 2 * tolerance).mean())
