"""`watching` is sent only for newly judged pairs of frames."""

import numpy as np
import pytest

from service.contract import FramePair, TactileFrame, wire
from service.decision.models import ModelSet, load_models
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from tests.service import drawn, tiny_models

ID = "test-1"
FIRST, LAST = 1, 12


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> ModelSet:
    return load_models(tiny_models.write_models(tmp_path_factory.mktemp("models") / "m"))


@pytest.fixture
def session(models: ModelSet) -> InsertionSession:
    """Armed with pair 0, at rest."""
    session = make_session(models, drawn.calibration())
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    session.handle(wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 0)
    (armed,) = session.on_pair(still(0), 0)
    assert armed.frame_captured_ns == 0
    return session


def still(index: int) -> FramePair:
    return drawn.pair(index, onset=100, slip_at=100)


def watched(session: InsertionSession, frames: list[TactileFrame]) -> list[int]:
    """Capture stamps that the service answers for."""
    messages = [m for f in frames for m in session.on_frame(f, f.captured_ns)]
    return [m.frame_captured_ns for m in messages if isinstance(m, wire.Watching)]


def both(pair: FramePair) -> list[TactileFrame]:
    return [pair.left, pair.right]


def test_every_judged_pair_is_answered_with_its_capture(session: InsertionSession) -> None:
    frames = [f for index in range(FIRST, LAST) for f in both(still(index))]
    assert watched(session, frames) == [index * drawn.PERIOD_NS for index in range(FIRST, LAST)]


def test_black_frames_are_not_watching(session: InsertionSession) -> None:
    frames = [
        TactileFrame(f.finger, f.seq, f.captured_ns, np.zeros_like(f.pixels))
        for index in range(FIRST, 4)
        for f in both(still(index))
    ]
    assert watched(session, frames) == []


def test_after_slip_or_a_cameras_fault_nobody_watches(session: InsertionSession) -> None:
    slipping = [f for index in range(FIRST, 30) for f in both(drawn.pair(index, onset=4, slip_at=8))]
    stamps = watched(session, slipping)
    assert stamps
    assert stamps[-1] < 14 * drawn.PERIOD_NS
    session.handle(wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 10**10)
    pair = drawn.pair(0, start_ns=10**10)
    session.on_pair(pair, pair.captured_ns)
    session.on_camera_fault("camera_stalled", "left stands still")
    assert watched(session, both(drawn.pair(1, start_ns=10**10))) == []
