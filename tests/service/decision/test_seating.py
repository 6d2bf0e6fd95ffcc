"""Full depth is an insertion only where the gels agree: by a whole session and by the evidence itself."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import FramePair, Sensor, TactileFrame, wire
from service.decision.claim import GraspRecord
from service.decision.models import ModelSet
from service.decision.seating import NOISE_PITCH, Push, SeatingEvidence, push_of, seating_evidence, strongest_push
from service.perception.markers.field import field_from_gel
from service.perception.observation import PairObservation
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from tests.service import drawn
from tests.service.decision.test_claim import descent, observation, pair, reasons, weighed

ID = "seat-1"
FRAMES = 30
NEVER = 10**6


@pytest.fixture
def session(models: ModelSet) -> InsertionSession:
    session = make_session(models, drawn.calibration())
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    return session


def stopped(outcome: str = "inserted") -> wire.Stopped:
    return wire.Stopped(insertion_id=ID, attempt=1, depth_mm=25.0, outcome=outcome)


def descend(session: InsertionSession, onset: int, frames: int = FRAMES) -> int:
    """Arm and go down for ``frames`` frames with an object that pushes from frame ``onset`` on; the time, ns."""
    session.handle(wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 0)
    for index in range(frames):
        pair = drawn.pair(index, onset=onset, slip_at=onset + 10)
        session.on_pair(pair, pair.captured_ns)
        if index == 1:
            session.handle(wire.Descending(insertion_id=ID, attempt=1), pair.captured_ns)
    return pair.captured_ns


def test_an_object_that_pushes_all_the_way_is_not_claimed(session: InsertionSession) -> None:
    now_ns = descend(session, onset=8)
    (finished,) = session.handle(stopped(), now_ns)
    assert (finished.type, finished.outcome, finished.cause) == ("finished", "not_confirmed", "not_confirmed")
    (doubt,) = finished.doubts
    assert doubt.reason == "push"
    assert "gels still carry a push of 0." in doubt.detail
    assert session.handle(stopped(), now_ns) == [finished], "asked again, it says the same"


def test_without_a_frame_that_tells_the_claim_waits_and_is_then_refused(session: InsertionSession) -> None:
    now_ns = descend(session, NEVER, frames=1)
    assert session.handle(stopped(), now_ns) == []
    assert session.on_tick(now_ns + 1_900_000_000) == []
    (finished,) = session.on_tick(now_ns + 2_100_000_000)
    assert (finished.outcome, [doubt.reason for doubt in finished.doubts]) == ("not_confirmed", ["not_seen"])


def test_a_frozen_camera_never_makes_a_claim(session: InsertionSession) -> None:
    descend(session, NEVER, frames=2)
    frozen = drawn.raw("left", 1, NEVER, NEVER + 10)
    messages = []
    for index in range(2, 100):
        pair = drawn.pair(index, onset=NEVER, slip_at=NEVER + 10)
        left = TactileFrame("left", index, pair.captured_ns, frozen)
        messages += session.on_pair(FramePair(left, pair.right), pair.captured_ns)
        messages += session.handle(stopped(), pair.captured_ns) if index == 20 else []
        messages += session.on_tick(pair.captured_ns)
        if session.finished:
            break
    assert [m.type for m in messages] == ["finished"]
    assert (messages[0].outcome, [doubt.reason for doubt in messages[0].doubts]) == ("not_confirmed", ["not_seen"])


# ---- the evidence itself --------------------------------------------------------------------------------------


def pair_of(up_px: tuple[float, float], spoil: float = 0.0, at: tuple[int, int] = (0, 0)) -> PairObservation:
    """Both fingers' fields, carried up by ``up_px``; ``spoil`` is put in one place of the left one."""
    fingers = []
    for finger, up in zip(("left", "right"), up_px, strict=True):
        gel = np.zeros((20, 21, 3), np.float32)
        gel[..., 1] = -up * 1.05 / 15
        field = field_from_gel(gel, 0, Sensor.load())
        if finger == "left":
            field.displacement_px[at] += np.float32(spoil)
        fingers.append(replace(observation(finger), field=field))
    return PairObservation(*fingers)


REST = pair_of((0.0, 0.0))


def test_the_push_is_the_weaker_fingers_and_what_the_grasp_bears_both_fingers() -> None:
    push = push_of(pair_of((3.0, 6.0)), REST)
    assert push.weaker_pitch == pytest.approx(0.2)
    assert push.mean_pitch == pytest.approx(0.3)
    assert strongest_push([push, push_of(pair_of((1.0, 1.0)), REST)]) == pytest.approx(0.3)
    assert strongest_push([]) == strongest_push([push_of(pair_of((math.nan, 0.0)), REST)]) == 0.0


@given(st.sampled_from([math.nan, math.inf, -math.inf]), st.integers(0, 19), st.integers(0, 20), st.floats(-40.0, 40.0))
def test_no_claim_is_ever_made_of_a_field_that_is_not_finite(
    bad: float, row: int, column: int, rest_of_it_px: float
) -> None:
    good = [Push(k * 33_000_000, 0.0, 0.0) for k in range(20)]
    spoilt = push_of(pair_of((rest_of_it_px, rest_of_it_px), bad, (row, column)), REST)
    assert not seating_evidence([*good, spoilt._replace(captured_ns=10**9)], 0, 0.5).seated


@pytest.mark.parametrize("status", ["lost", "duplicate", "no_grid"])
def test_a_field_without_new_evidence_tells_nothing(status: str) -> None:
    pair = pair_of((0.0, 0.0))
    blind = replace(pair.right, field=replace(pair.right.field, status=status))
    assert math.isnan(push_of(PairObservation(pair.left, blind), REST).weaker_pitch)


@pytest.mark.parametrize(("push", "bears", "seated"), [(0.0075, 0.0, True), (0.0085, 0.0, False), (0.0085, 0.3, True)])
@pytest.mark.parametrize("share", [0.028, 0.032])
def test_a_push_counts_from_the_noise_on_or_from_three_hundredths_of_what_the_grasp_bears(
    push: float, bears: float, seated: bool, share: float
) -> None:
    assert SeatingEvidence(push, bears).seated == seated
    assert SeatingEvidence(share, 1.0).seated == (share < 0.03)


@pytest.mark.parametrize(("from_share", "seated"), [(0.62, False), (0.72, True)])
def test_a_push_is_lasting_where_it_fills_the_last_third_of_the_way(from_share: float, seated: bool) -> None:
    """But for a tenth of its frames."""
    pushes = [Push(k * 10_000_000, 0.2 * (k >= 100 * from_share), 0.2) for k in range(101)]
    assert seating_evidence(pushes, 0, 0.2).seated == seated


@pytest.mark.parametrize(("missing_n", "seated"), [(2, False), (5, True)])
def test_a_tenth_of_the_frames_may_show_nothing_of_a_push(missing_n: int, seated: bool) -> None:
    pushes = [Push(k * 10_000_000, 0.2 * (not 70 <= k < 70 + missing_n), 0.2) for k in range(101)]
    assert seating_evidence(pushes, 0, 0.2).seated == seated


@pytest.mark.parametrize(("rows_n", "known"), [(10, False), (11, True)])
def test_half_of_the_markers_of_each_finger_are_enough_to_tell_a_push(rows_n: int, known: bool) -> None:
    pair = pair_of((3.0, 3.0))
    pair.left.field.valid[rows_n:] = False
    assert math.isfinite(push_of(pair, REST).mean_pitch) == known


def test_how_far_the_markers_moved_counts_every_way() -> None:
    assert push_of(pair_of((3.0, 6.0)), REST).moved_pitch == pytest.approx(math.sqrt((0.2**2 + 0.4**2) / 2))


@given(st.lists(st.floats(0.25, 0.6), min_size=40, max_size=90), st.data())
def test_a_grasp_that_slides_is_seen_whatever_single_frames_miss(pushes: list[float], data: st.DataObject) -> None:
    """A tenth of the frames may show nothing, or no push, as long as the newest does."""
    missed = data.draw(st.sets(st.integers(0, len(pushes) - 2), max_size=1))
    series = [
        Push(index * 33_000_000, math.nan if index in missed and index % 2 else 0.0 if index in missed else push, push)
        for index, push in enumerate(pushes)
    ]
    assert not seating_evidence(series, 0, 0.5).seated


@given(st.floats(0.0, 0.9 * NOISE_PITCH), st.floats(0.0, 1.0))
def test_what_the_walls_of_a_gap_leave_is_claimed_whatever_the_grasp_bears(rub: float, bears: float) -> None:
    assert seating_evidence([Push(k * 33_000_000, rub, rub) for k in range(75)], 0, bears).seated


def test_the_operator_reads_the_push_and_what_it_is_compared_with() -> None:
    text = str(SeatingEvidence(0.48, 0.5))
    assert "0.480 marker pitches, 96% of the strongest they bore (in a gap: below 0.015)" in text
    assert "strongest" not in str(SeatingEvidence(0.48, 0.0))


@pytest.mark.parametrize(
    ("left", "right", "doubted"), [(-2.0, -1.7, True), (-2.0, -1.5, False), (-30.0, 0.1, False), (-30.0, None, False)]
)
def test_an_object_that_stood_on_the_blocks_as_it_was_armed_has_not_come_along(
    left: float, right: float | None, doubted: bool
) -> None:
    """As one longer than stated: its gels slide from the reference on, and no push is added. One that hangs weighs."""
    attempt = descent(reference=weighed(pair(), left, right))
    assert reasons(attempt) == (["push"] if doubted else [])
    assert reasons(attempt, GraspRecord(width_mm=50.0, blocked_pitch=0.5)) == []
