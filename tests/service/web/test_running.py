"""The insertion under way, as the page shows it, from the messages of both sides."""

from service.contract import wire
from service.web.page.running import Running

ARM = wire.Arm(insertion_id="box", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)


def test_why_nothing_was_decided_stays_readable_until_the_next_attempt() -> None:
    running = Running("box")
    running.from_client(ARM)
    detail = "neither finger saw the object move"
    running.from_service(wire.NoDecision(insertion_id="box", attempt=1, reason="no_motion", detail=detail))
    running.robot(wire.RobotSample(at_ns=1, phase="retracting", attempt=1, depth_mm=2.0))
    assert (running.phase, running.problem, running.depth_mm) == ("no_decision", detail, 2.0)
    running.from_client(ARM.model_copy(update={"attempt": 2}))
    assert (running.phase, running.problem) == ("arming", ""), "or it would pass for the cause of what comes"
    running.robot(wire.RobotSample(at_ns=2, phase="descending", attempt=2))
    assert running.phase == "descending"


def test_attempts_over_several_grasps_never_exceed_the_most_that_is_shown() -> None:
    running = Running("box", descended_n=4).goes_on("again")
    running.from_client(ARM.model_copy(update={"attempt": 3}))
    assert (running.attempt, running.most_n) == (7, 15)
    running.from_client(ARM.model_copy(update={"attempt": 15}))
    assert (running.attempt, running.most_n) == (19, 19)
