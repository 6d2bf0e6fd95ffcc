"""An insertion fed to the state machine, event by event: the messages, the plan, and the way to each phase."""

from robot_client.insertion.events import MOTION_COMMANDS, Arrived, Begin, FromService, Grasped, Hold, Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.machine import Phase, Plan, State, step
from robot_client.insertion.motion import Ramp, Ramps
from service.contract import wire

ID = "t-1"
APPROACH = WorkPose(x_mm=8.0, y_mm=0.0, z_mm=35.0, yaw_deg=6.0)
RAMPS = Ramps(descend=Ramp(speed_mm_s=10.0, acceleration_mm_s2=100.0, jerk_mm_s3=2000.0))
PLAN = Plan(insertion_id=ID, approach=APPROACH, gap_width_mm=56.0, expected_depth_mm=25.0, ramps=RAMPS)
LIMITS = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)

CLOCK = wire.Clock(sent_ns=0, service_ns=0)


def hello(insertion_id=ID, **changes):
    return wire.ServiceHello(
        insertion_id=insertion_id,
        **{"models": (), "cameras": (), "controller": "belief", "limits": LIMITS, "clock": CLOCK, **changes},
    )


def armed(attempt, insertion_id=ID, at_s=0.0):
    """The service's clock equals ours."""
    captured_ns = round(at_s * 1e9)
    return wire.Armed(insertion_id=insertion_id, attempt=attempt, reference_seq=3, frame_captured_ns=captured_ns)


def watching(attempt, captured_s, insertion_id=ID):
    captured_ns = round(captured_s * 1e9)
    return wire.Watching(
        insertion_id=insertion_id, attempt=attempt, frame_captured_ns=captured_ns, judged_ns=captured_ns
    )


def slip(attempt, insertion_id=ID, pressed_mm=0.4):
    return wire.Slip(
        insertion_id=insertion_id,
        attempt=attempt,
        finger="right",
        frame_seq=9,
        captured_ns=1,
        age_ms=4.0,
        score=8.0,
        reason="r",
        pressed_mm=pressed_mm,
    )


def correction(attempt, dx=-3.0, dtheta=-2.0, insertion_id=ID):
    return wire.Correction.model_construct(
        type="correction",
        insertion_id=insertion_id,
        attempt=attempt,
        dx_mm=dx,
        dtheta_deg=dtheta,
        class_probabilities={},
        estimate=wire.Estimate(dx_mm=4.0, dtheta_deg=3.0),
        confidence=0.9,
        controller="belief",
        reason="r",
        latency_ms={},
    )


def no_decision(attempt, reason="no_motion", insertion_id=ID):
    return wire.NoDecision(insertion_id=insertion_id, attempt=attempt, reason=reason, detail="d")


def service(message, at_s=0.0):
    return FromService.model_construct(at_s=at_s, kind="service", message=message)


def run(events, state=None):
    """All commands of ``events`` in order, and the state after them."""
    state, all_commands = state or State(PLAN), []
    for event in events:
        state, commands = step(state, event)
        all_commands += commands
    return state, all_commands


def held(state, commands):
    """Why an insertion has failed: with its last step the arm is held, and nothing moves."""
    assert (state.phase, type(commands[0])) == (Phase.FAILED, Hold)
    assert not [command for command in commands if isinstance(command, MOTION_COMMANDS)]
    return state.reason


def at(pose, kind=Arrived, at_s=0.0):
    return kind(at_s=at_s, pose=pose)


ABOVE = APPROACH.at_height(60.0)
TO_ARMING = [
    Begin(at_s=0.0, pose=WorkPose(x_mm=0.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0), held=True),
    service(hello()),
    Grasped(at_s=0.0, width_mm=50.0),
    at(WorkPose(x_mm=0.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)),
    at(ABOVE),
    at(APPROACH),
]
TO_DESCENT = [*TO_ARMING, service(armed(1))]
TO_STOP = [*TO_DESCENT, service(slip(1))]
TO_DECISION = [*TO_STOP, at(APPROACH.at_height(28.0), Standstill)]
TO_CLOSING = [*TO_DESCENT, at(APPROACH.at_height(10.0)), at(APPROACH.at_height(10.02), Standstill)]
