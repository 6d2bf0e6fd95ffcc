"""Decides a recorded sequence of frames like a running insertion, for users with frames and no arm."""

from collections.abc import Sequence
from typing import Any

from service.contract import FramePair, wire
from service.decision.evidence import Refusal
from service.decision.models import ModelSet
from service.session.factory import make_session

NAME = "recorded-sequence"
LATER_NS = 60_000_000_000  # beyond every deadline of a session
ENDS = ("slip", "enough")


def decide(
    models: ModelSet,
    pairs: Sequence[FramePair],
    gap_width_mm: float,
    *,
    speed_mm_s: float | None = None,
    **conditions: float | None,
) -> wire.Correction:
    """A session's answer to one attempt with these rectified pairs, starting from rest, at rising stamps.

    ``speed_mm_s`` of the descent is required by networks that read depth; ``conditions``: grip, shear reach and grasp
    height as in `wire.Arm`. The arm counts as stopped where the session orders it, else at the last pair. Raises
    Refusal with the reason if there is no correction.
    """
    named: dict[str, Any] = {"insertion_id": NAME, "attempt": 1}
    session, began_ns = make_session(models), pairs[0].captured_ns
    stated = named | conditions | {"gap_width_mm": gap_width_mm, "expected_depth_mm": 1000.0}
    replies = session.handle(wire.ClientHello(insertion_id=NAME, client=NAME), began_ns)
    replies += session.handle(wire.Arm.model_validate(stated), began_ns)
    descends = stopped = False
    for pair in pairs:
        now_ns = pair.captured_ns
        replies += session.on_pair(pair, now_ns)
        if not descends and any(reply.type == "armed" for reply in replies):
            descends, began_ns = True, now_ns
            replies += session.handle(wire.Descending(**named, speed_mm_s=speed_mm_s), now_ns)
        if not stopped and (pair is pairs[-1] or any(reply.type in ENDS for reply in replies)):
            stopped, depth_mm = True, (speed_mm_s or 0.0) * (now_ns - began_ns) * 1e-9
            replies += session.handle(wire.Stopped(**named, depth_mm=depth_mm, outcome="blocked"), now_ns)
    replies += session.on_tick(now_ns + LATER_NS)
    return _correction(replies)


def _correction(replies: Sequence[wire.ServiceMessage]) -> wire.Correction:
    """The correction among a session's answers; raises Refusal with the answer that came instead."""
    for reply in replies:
        if isinstance(reply, wire.Correction):
            return reply
        if isinstance(reply, wire.NoDecision):
            raise Refusal(reply.reason, reply.detail)
        if isinstance(reply, wire.Refused):
            raise Refusal("out_of_distribution", f"{reply.reason}: {reply.detail}")
    raise Refusal("too_few_frames", "the gels show no attempt: expected pairs from rest to the stop")
