"""A rehearsal before the service is ready, so that the first decision finds everything as warm as the later ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.contract import TactileFrame, wire
from service.controllers import make_controller
from service.decision import DecisionRun, Refusal
from service.insertion_session import InsertionSession

REPEATS = 3


def rehearse(session: InsertionSession, frames: Sequence[TactileFrame]) -> None:
    """Perceive each finger's frame a few times, decide on a still gel, move every controller; nothing is kept.

    ``frames`` are what the cameras show now. Raises ContractError if a frame is neither raw nor rectified.
    """
    for frame in frames:
        watch = session.left if frame.finger == "left" else session.right
        for repeat in range(REPEATS):
            seen = np.bitwise_xor(frame.pixels, np.uint8(repeat))  # the tracker skips a picture that it has just seen
            watch.observe(replace(frame, pixels=seen, captured_ns=frame.captured_ns + repeat))
            watch.rearm()
    card = session.models.card
    still = np.zeros((2, *card.input_shape), np.uint8 if card.markers is None else np.float32)
    run = DecisionRun(session.models, still, gap_width_mm=50.0)
    for _ in range(card.frames_per_decision):
        run.step(still)
    for name in ("heuristic", "belief"):
        try:
            evidence = run.evidence()
            command = make_controller(name, session.limits).decide(evidence, 1)
        except Refusal:
            continue  # of fingers that feel nothing no move has to follow
        wire.Fault(insertion_id="rehearsal", code=command.controller, detail=command.reason).model_dump_json()
