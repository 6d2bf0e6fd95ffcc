"""A warm-up before the service is ready, so that the first decision is as fast as the later ones."""

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraFrame, now_ns
from service.contract import FINGERS, FramePair, TactileFrame, wire
from service.decision.controllers import make_controller
from service.decision.evidence import DecisionRun, Refusal
from service.recordings.writer import Recorder
from service.session.insertion import Insertion
from service.session.state_machine import InsertionSession, ignore

STILL_N = 3  # pairs at rest before the picture begins to move, by a pixel per frame
NAME = "warm-up"


def warm_up(session: InsertionSession, frames: Sequence[TactileFrame]) -> None:
    """Play an attempt through a session without a client, then call every controller; nothing is kept.

    ``frames``: the cameras' present frames, one per finger. Raises ContractError if one is neither raw nor rectified.
    """
    if len(frames) == len(FINGERS):
        with _recorder() as recorder:
            _attempt(Insertion(session, recorder, _serialise, _nobody_watches), frames)
        session.on_attempt = ignore  # it refers to its insertion, which would be freed late
    _decide(session)


def _attempt(insertion: Insertion, frames: Sequence[TactileFrame]) -> None:
    """The calls of a real attempt: the picture rests and moves, the arm stops, and the last pair gives the answer."""
    needed = insertion.session.models.card.frames_per_decision
    insertion.message(wire.ClientHello(insertion_id=NAME, client=NAME))
    insertion.message(wire.Arm(insertion_id=NAME, attempt=1, gap_width_mm=50.0, expected_depth_mm=25.0))
    for index in range(STILL_N + needed):
        if index == STILL_N + needed - 1:
            insertion.message(wire.Stopped(insertion_id=NAME, attempt=1, depth_mm=5.0, outcome="blocked"))
        left, right = (_moved(frame, index) for frame in sorted(frames, key=lambda frame: frame.finger))
        for frame, pair in ((left, None), (right, FramePair(left, right))):
            insertion.frame(CameraFrame(frame, None), pair)
    insertion.message(wire.Abort(insertion_id=NAME, cause="operator", reason="warmed up"))


def _moved(frame: TactileFrame, index: int) -> TactileFrame:
    """The frame as a camera would show it later; the tracker skips a repeated picture."""
    shifted = np.roll(frame.pixels, max(0, index + 1 - STILL_N), axis=0)
    return replace(frame, seq=index, captured_ns=now_ns(), pixels=np.bitwise_xor(shifted, np.uint8(index % 2)))


def _decide(session: InsertionSession) -> None:
    """Networks and controllers on a still gel."""
    card = session.models.card
    still: NDArray[Any] = np.zeros((2, *card.input_shape), card.input_dtype)
    run = DecisionRun(session.models, still, gap_width_mm=50.0)
    for _ in range(card.frames_per_decision):
        run.step(still)
    for name in ("heuristic", "belief"):
        try:
            evidence = run.evidence()
            command = make_controller(name, session.limits).decide(evidence, 1)
        except Refusal:
            continue  # fingers without contact may give no move
        _serialise(wire.Fault(insertion_id=NAME, code="internal", detail=command.reason))


@contextlib.contextmanager
def _recorder() -> Iterator[Recorder | None]:
    """A recorder whose file is deleted afterwards; None where no file can be made."""
    with contextlib.ExitStack() as stack:
        recorder = None
        with contextlib.suppress(OSError):
            recorder = Recorder(Path(stack.enter_context(tempfile.TemporaryDirectory())), NAME, {})
        try:
            yield recorder
        finally:
            if recorder:
                recorder.close({})


def _serialise(message: wire.ServiceMessage) -> None:
    message.model_dump_json()


def _nobody_watches(kind: str, content: Any) -> None:
    """The warm-up is not published."""
