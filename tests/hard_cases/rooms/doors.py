"""The interfaces of every package: functions that take numbers from outside refuse non-finite ones by name."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from robot_client.grippers.wsg50.codec import encode_request
from robot_client.grippers.wsg50.codes import Command
from robot_client.insertion.geometry import CellFrame, Pose, WorkPose, multiply, normalised, rotate, turn_quaternion
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import MotionGuide, Ramps
from robot_client.insertion.profile import plan_profile
from robot_client.robots.abb_egm.codec import Guidance, RobotState, encode_guidance, encode_robot
from service.contract import Sensor, wire
from service.decision.belief import BeliefGrid
from service.decision.controllers import axis_command, make_controller
from service.decision.evidence import Refusal, from_joint, from_pair, softmax
from service.perception.rectification import CameraCalibration
from service.perception.slip.detector import SlipDetector
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.rigid import fit_motion, moving_patch
from simulation.optics.renderer import Appearance, Renderer
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.hard_cases.instead import blind
from tests.hard_cases.registry import Guard, case, non_finite, not_refused
from tests.hard_cases.rooms.decision import LIMITS, _cards, evidence_for
from tests.hard_cases.rooms.motion import pose
from tests.service.perception.synthetic import patch_fields, rigid
from tests.simulation.strategies import made_up_trial
from training.data.labels import class_of
from training.metrics.figures import Predictions

SENSOR = Sensor.load()

BAD = (math.nan, math.inf, -math.inf)
Door = Callable[[float], object]


def shut(doors: list[Door], error: type[Exception] = ValueError) -> float:
    """How many (door, bad number) pairs let the number in."""
    return not_refused([lambda d=d, v=v: d(v) for d in doors for v in BAD], error)


@case(
    "decision",
    why="NaN passes every comparison, clip and maximum on its way to the arm",
    holds="every function of the decision refuses it as non_finite: functions that do not",
    guard=Guard("service.decision.belief:BeliefGrid.move", "every number counts as finite", blind),
)
def doors_of_the_decision(_seed: int) -> float:
    direction, magnitude, joint = _cards()
    shape = (1, len(joint.grid_x_mm), len(joint.grid_theta_deg))

    def pair(logit: float, error: float) -> object:
        moments = {"error": np.full((1, 2), error), "log_sigma": np.zeros((1, 2))}
        return from_pair(direction, magnitude, {"logits": np.full((1, 9), logit)}, moments)

    doors: list[Door] = [
        lambda v: axis_command(1, v, first=True),
        lambda v: softmax(np.array([v, 1.0])),
        lambda v: pair(v, 0.0),
        lambda v: pair(0.0, v),
        lambda v: from_joint(joint, {"log_density": np.full(shape, v)}),
        lambda v: BeliefGrid().move(v, 0.0),
        lambda v: BeliefGrid().move(0.0, v),
        lambda v: make_controller("heuristic", LIMITS).decide(evidence_for("5", (v, 0.0)), 1),
        lambda v: make_controller("belief", LIMITS).decide(evidence_for("5", (0.0, v)), 1),
    ]
    return shut(doors, Refusal)


@case(
    "motion",
    why="a target is a dozen multiplications away from the number that spoiled it",
    holds="every function of the robot client that takes numbers refuses NaN: functions that do not",
    guard=Guard("robot_client.insertion.geometry:turn_quaternion", "every number counts as finite", blind),
)
def doors_of_the_robot_client(_seed: int) -> float:
    def advance(value: float) -> object:
        guide = MotionGuide(Limits(), Ramps(), pose())
        guide.move(pose(x=1.0), "travel")
        before = guide.target
        after = guide.advance(value, 0.0)
        if value < 0 and after == before:
            raise ValueError("stood still")
        return after

    doors: list[Door] = [
        lambda v: WorkPose(x_mm=v, y_mm=0.0, z_mm=0.0, yaw_deg=0.0),
        lambda v: pose().corrected(v, 0.0),
        lambda v: pose().tilted(v),
        lambda v: pose().towards(pose(x=1.0), v),
        lambda v: multiply((v, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        lambda v: rotate((1.0, 0.0, 0.0, 0.0), (v, 0.0, 0.0)),
        lambda v: normalised((v, 0.0, 0.0, 1.0)),
        turn_quaternion,
        lambda v: turn_quaternion(0.0, v),
        lambda v: CellFrame(origin_mm=(0.0, v, 0.0)),
        lambda v: CellFrame(rotation=(v, 0.0, 0.0, 0.0)),
        lambda v: CellFrame().from_controller(Pose(v, 0.0, 0.0)),
        lambda v: plan_profile(v, 1.0, 1.0, 1.0),
        lambda v: plan_profile(1.0, 1.0, 1.0, v),
        advance,
        lambda v: encode_guidance(Guidance(1, 1, Pose(0.0, 0.0, v))),
        lambda v: encode_robot(RobotState(1, 1, Pose(v, 0.0, 0.0))),
        lambda v: encode_request(Command.GRASP, v, 30.0),
        lambda v: Limits(max_speed_mm_s=v),
        lambda v: wire.Limits(max_dx_mm=v, max_dtheta_deg=1.0, max_frame_age_ms=1.0),
    ]
    return shut(doors)


@case(
    "physics",
    why="one NaN node spreads over the whole gel with the next solve",
    holds="poses, scenes, gel states and trials with NaN are refused: functions that do not",
    guard=Guard("simulation.physics.quasistatic:QuasiStaticCell.regrasp", "every number counts as finite", blind),
)
def doors_of_the_simulator(seed: int) -> float:
    cell, renderer = QuasiStaticCell(load_scene("circle"), seed), Renderer(Appearance())

    def gel(value: float) -> np.ndarray:
        state = np.zeros((20, 21, 3), np.float32)
        state[seed, 3, 1] = value
        return state

    doors: list[Door] = [
        lambda v: cell.regrasp(v, 0.0),
        lambda v: cell.regrasp(0.0, v),
        lambda v: cell.move_to(0.0, v, 40.0, 0.0),
        lambda v: load_scene("circle", gel__friction=v),
        lambda v: load_scene("circle", object__mass_kg=v),
        lambda v: renderer.raw(gel(v), 0),
        lambda v: renderer.rectified(gel(v), 0),
        lambda v: made_up_trial(0, x_mm=v).check(),
    ]
    return shut(doors) + non_finite(cell.look().gel)


@case(
    "networks",
    why="a mean over a thousand trials hides a NaN, or becomes one",
    holds="labels and predictions with NaN are refused before any figure: functions that do not",
    guard=Guard("training.metrics.figures:Predictions.__post_init__", "every number counts as finite", blind),
)
def doors_of_the_training(_seed: int) -> float:
    def predictions(**changed: float) -> Predictions:
        fields = {
            "logits": np.zeros((3, 9)),
            "error": np.zeros((3, 2)),
            "log_sigma": np.zeros((3, 2)),
            "truth": np.zeros((3, 2)),
        }
        for name, value in changed.items():
            fields[name][1, 1] = value
        return Predictions(**fields, objects=np.array(["a"] * 3))

    doors: list[Door] = [
        lambda v: class_of(np.array([[v, 1.0]], np.float32)),
        lambda v: predictions(logits=v),
        lambda v: predictions(error=v),
        lambda v: predictions(log_sigma=v),
        lambda v: predictions(truth=v),
    ]
    return shut(doors)


@case(
    "perception",
    why="a field from elsewhere (a recording, another tracker) may contain a NaN node",
    holds="detectors stay typed and finite, fits return none, calibrations refuse: non-finite numbers",
    guard=Guard("service.perception.slip.rigid:moving_patch", "every number counts as finite", blind),
)
def doors_of_the_perception(seed: int) -> float:
    rng = np.random.default_rng(seed)
    fields, _ = patch_fields(rigid(degrees=1.0), frames=3, seed=seed)
    wrong = 0.0
    for value in BAD:
        spoilt = fields[2].displacement_px.copy()
        spoilt[5 + seed, 5] = value
        field = replace(fields[2], displacement_px=spoilt)
        slip, onset = SlipDetector(), OnsetDetector()
        slip.rearm(fields[0])
        onset.rearm(fields[0])
        onset.update(field)
        with np.errstate(all="ignore"):
            states = (slip.update(field), GraspWatch().update(field))
            before = rng.uniform(0, 300, (20, 21, 2))
            after = np.where(rng.random((20, 21, 1)) < 0.05, value, before + 1.0)
            motion = moving_patch(before, after, np.ones((20, 21), np.bool_), 1.0, 15.0)
            points = after.reshape(-1, 2)
            fit = fit_motion(before.reshape(-1, 2), points, np.ones(len(points)), 15.0, scale=True)
        wrong += sum(non_finite(s.residual_px, s.score, s.angle_rad, s.scale, *s.shift_px) for s in states)
        wrong += non_finite(motion.angle_rad, motion.shift_px, motion.pivot_px) + float(fit is not None)
    matrix = [np.diag([1.0, value, 1.0]) for value in BAD]
    return wrong + not_refused(
        [lambda m=m: CameraCalibration(m, SENSOR.raw, SENSOR.rectified) for m in matrix], ValueError
    )
