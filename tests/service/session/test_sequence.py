"""The released networks give the same answer to a sequence as to frames arriving one by one."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from robot_client.insertion.state import Phase
from service.contract import FramePair, wire
from service.contract.shipped import released_models
from service.decision.evidence import Refusal
from service.perception.rectification import Rectifier
from service.session.sequence import _correction, decide
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


class Scripted:
    """Stands in for a session that arms with the second pair and orders a stop with the fifth; keeps what it hears."""

    def __init__(self, ends_with=None):
        self.heard, self.pairs_n, self.ends_with = [], 0, ends_with

    def handle(self, message, now_ns):
        self.heard.append((message.type, now_ns, message))
        return []

    def on_pair(self, _pair, now_ns):
        self.pairs_n += 1
        self.heard.append(("pair", now_ns, None))
        kind = {2: "armed", 5: self.ends_with}.get(self.pairs_n)
        return [SimpleNamespace(type=kind)] if kind else []

    def on_tick(self, now_ns):
        self.heard.append(("tick", now_ns, None))
        return [wire.NoDecision(insertion_id="x", attempt=1, reason="no_motion", detail="nothing moved")]


PERIOD_NS = 33_000_000
PAIRS = [SimpleNamespace(captured_ns=10**10 + number * PERIOD_NS) for number in range(8)]


@pytest.mark.parametrize(("order", "last"), [(None, 7), ("slip", 4), ("enough", 4)])
@pytest.mark.parametrize("speed_mm_s", [8.0, None])
def test_a_sequence_is_told_as_an_attempt_that_descends_from_its_reference_and_stops_where_it_is_ordered(
    monkeypatch, order, last, speed_mm_s
):
    session = Scripted(order)
    monkeypatch.setattr("service.session.sequence.make_session", lambda _: session)
    with pytest.raises(Refusal, match="nothing moved") as refused:
        decide(None, PAIRS, 56.0, speed_mm_s=speed_mm_s, grip_n=30.0)
    assert refused.value.reason == "no_motion"
    messages = {kind: (message, now_ns) for kind, now_ns, message in session.heard if message is not None}
    kinds = [kind for kind, *_ in session.heard]
    assert [kind for kind in kinds if kind != "pair"] == ["hello", "arm", "descending", "stopped", "tick"]
    assert (session.pairs_n, kinds.index("descending"), kinds.index("stopped")) == (8, 4, 4 + last)
    assert (messages["arm"][0].gap_width_mm, messages["arm"][0].grip_n) == (56.0, 30.0)
    assert messages["descending"][0].speed_mm_s == speed_mm_s
    stop, stopped_ns = messages["stopped"]
    assert (stopped_ns, stop.outcome) == (PAIRS[last].captured_ns, "blocked")
    assert stop.depth_mm == pytest.approx((speed_mm_s or 0.0) * (last - 1) * PERIOD_NS * 1e-9)
    assert session.heard[-1][1] >= PAIRS[-1].captured_ns + 20 * 10**9, "beyond every deadline"


def test_a_sequence_that_is_refused_or_no_attempt_says_so():
    refused = wire.Refused(insertion_id="x", attempt=1, reason="nothing_held", detail="both gels look untouched")
    with pytest.raises(Refusal, match="nothing_held: both gels look untouched"):
        _correction([SimpleNamespace(type="hello"), refused])
    with pytest.raises(Refusal, match="no attempt"):
        _correction([SimpleNamespace(type="hello")])
