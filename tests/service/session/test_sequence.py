"""The released networks give the same answer to a sequence as to frames arriving one by one."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from robot_client.insertion.state import Phase
from service.contract import FramePair, wire
from service.contract.shipped import released_models
from service.decision.evidence import Refusal
from service.perception.rectification import Rectifier
from service.session.sequence import decide
from service.session.state_machine import InsertionSession
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import models_of, stage


@pytest.fixture(scope="module")
def attempt():
    """The rectified pairs of an attempt in lock step, its stated conditions, and the resulting correction."""
    insertion = stage(Job("rectangle", 0, 8.0, 5.0, 5, "belief", "pictures"), models_of(released_models()))
    pairs, messages = [], {}
    on_pair, handle = InsertionSession.on_pair, InsertionSession.handle

    def shown(session, pair, now_ns):
        pairs.append(pair)
        return on_pair(session, pair, now_ns)

    def heard(session, message, now_ns):
        if isinstance(message, wire.Arm) and message.attempt > 1:
            insertion.until = frozenset(Phase)
        messages.setdefault(message.type, message)
        return handle(session, message, now_ns)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(InsertionSession, "on_pair", shown)
        patched.setattr(InsertionSession, "handle", heard)
        insertion.run()
    rectifiers = [Rectifier(insertion.cell.calibration(index)) for index in range(2)]
    rectified = [
        FramePair(
            *(replace(one, pixels=to.apply(one.pixels)) for one, to in zip((p.left, p.right), rectifiers, strict=True))
        )
        for p in pairs[1:]  # the first shows the open gels
    ]
    stated = messages["arm"].model_dump(include={"gap_width_mm", "grasp_height_mm", "grip_n", "shear_reach_mm"})
    return rectified, stated | {"speed_mm_s": messages["descending"].speed_mm_s}, insertion.trials[0]["decision"]


def test_frames_alone_are_decided_as_they_were_when_they_came(attempt):
    pairs, stated, live = attempt
    answer = decide(models_of(released_models()), pairs, **stated)
    assert answer.estimate.dx_mm == pytest.approx(live["estimate"]["dx_mm"], abs=0.3)
    assert answer.estimate.dtheta_deg == pytest.approx(live["estimate"]["dtheta_deg"], abs=0.5)


def test_frames_without_a_speed_or_without_a_touch_are_refused_by_name(attempt):
    pairs, stated, _ = attempt
    with pytest.raises(Refusal, match="speed_mm_s"):
        decide(models_of(released_models()), pairs, **stated | {"speed_mm_s": None})
    with pytest.raises(Refusal, match="neither finger saw the object move"):
        decide(models_of(released_models()), pairs[:6], **stated)


@pytest.mark.parametrize(
    ("order", "stands_at", "depth_mm"), [("slip", 5, 1.2), ("enough", 5, 1.2), ("watching", 9, 2.8)]
)
def test_the_arm_is_stated_to_have_gone_as_far_as_its_speed_took_it_and_to_stand_where_it_was_ordered(
    monkeypatch, order, stands_at, depth_mm
):
    """Pairs 0.1 s apart; the session arms with the third one and gives its order with the sixth; 4 mm/s."""
    sent, ticked_ns = [], []

    def on_pair(pair, _now_ns):
        return [SimpleNamespace(type={2: "armed", 5: order}.get(pair, "watching"))]

    class Pair(int):
        captured_ns = property(lambda self: 10**10 + self * 10**8)

    session = SimpleNamespace(
        handle=lambda message, now_ns: sent.append((message, now_ns)) or [],
        on_pair=on_pair,
        on_tick=lambda now_ns: ticked_ns.append(now_ns) or [],
    )
    monkeypatch.setattr("service.session.sequence.make_session", lambda _models: session)
    with pytest.raises(Refusal, match="expected pairs from rest to the stop"):
        decide(None, [Pair(index) for index in range(10)], 56.0, speed_mm_s=4.0)
    assert [message.type for message, _ in sent] == ["hello", "arm", "descending", "stopped"]
    (descending, began_ns), (stopped, stopped_ns) = sent[2:]
    assert (descending.speed_mm_s, began_ns, stopped_ns) == (4.0, Pair(2).captured_ns, Pair(stands_at).captured_ns)
    assert (stopped.depth_mm, stopped.outcome) == (pytest.approx(depth_mm), "blocked")
    assert ticked_ns[0] - Pair(9).captured_ns > 30 * 10**9
