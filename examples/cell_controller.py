"""A cell controller in one file: docs/api.md, implemented safely. It needs only Python and `websockets`.

    insert(arm, token, Task(name="box-17", gap_width_mm=56.0, depth_mm=25.0))

`Arm` is the interface to your robot and gripper, `token` the content of the file that the service names at its start.
The most important rule: the arm descends only while the newest frame judged by the service is recent. In every other
case it stops and holds, and `Held` gives the reason.
"""

import contextlib
import json
import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

URL = "ws://127.0.0.1:8000/v1/insertion"
PROTOCOL, ATTEMPTS = 2, 15
TRAVEL_MM = 1.5  # the furthest way from the capture of the last judged frame to standstill
HEARTBEAT_S = 0.5
READY_S, ANSWER_S = 5.0, 15.0  # the service answers within 2 s, and after `stopped` within 10 s
FINISHED_S = 30.0  # at full depth it waits for its recording, on a slow disk, too
CAMERA_FAULTS = {"camera_lost", "camera_stalled", "camera_frozen", "camera_size", "stale_frames"}
FINAL_REASONS = {"non_finite", "contradictory"}  # of `no_decision`: probing again would not help
MOST_NO_DECISIONS = 2  # in a row

Message = dict[str, Any]


class Arm(Protocol):
    """Your robot and gripper. Each call returns when it is done, `descend` and `go_on` at once; each may raise."""

    def grasp(self) -> None:
        """Close the fingers on the object."""

    def width_mm(self) -> float | None:
        """How far the fingers are apart, None if the gripper does not tell."""

    def descend(self, depth_mm: float, speed_mm_s: float, for_s: float) -> None:
        """Begin to move straight down by ``depth_mm``, for ``for_s`` from now at most."""

    def go_on(self, for_s: float) -> None:
        """Move on for ``for_s`` from now at most; then the arm's watchdog ends the descent, whatever became of us."""

    def descending(self) -> bool:
        """Whether that motion is still under way."""

    def stop(self) -> None:
        """Stand still. Called after every descent and on every error, also where nothing moves."""

    def depth_mm(self) -> float:
        """How far it stands, measured, below the pose where its last descent began."""

    def retract(self) -> None:
        """Back up along the same vertical, to the pose where the last descent began."""

    def move_by(self, dx_mm: float, dtheta_deg: float) -> None:
        """Move across the gap (work-object x) and turn about the vertical, counter-clockwise from above."""


class Held(RuntimeError):  # noqa: N818 it says what is
    """The insertion is over and the arm stands still: somebody has to look. ``cause`` is what `abort` tells."""

    def __init__(self, cause: str, text: str) -> None:
        super().__init__(text)
        self.cause = cause


@dataclass(frozen=True)
class Task:
    """What is to be inserted; ``stop_lag_s`` is how long your arm goes on after `stop`, measured.

    ``name`` is that of this insertion, a new one each time.
    ``neighbours_stay`` states that no press pushes aside what stands beside the gap; else none is inserted after one.
    ``continues`` names the insertion of the same object that a person has taken out of the hand and put back upright.
    """

    name: str
    gap_width_mm: float
    depth_mm: float
    grasp_height_mm: float | None = None
    speed_mm_s: float = 10.0
    stop_lag_s: float = 0.04
    neighbours_stay: bool = False
    continues: str | None = None

    @property
    def lease_s(self) -> float:
        """How old the newest judged frame may be while the arm goes down."""
        return TRAVEL_MM / self.speed_mm_s - self.stop_lag_s


class Service:
    """The connection of one insertion: messages both ways, and the clocks of both sides."""

    def __init__(self, link: ClientConnection, name: str) -> None:
        self._link, self._name = link, name
        self._ahead_ns: deque[int] = deque(maxlen=20)  # our clock less the service's, at least; old ones drift away

    def say(self, kind: str, **fields: Any) -> None:
        """Send a message."""
        self._link.send(json.dumps({"type": kind, "insertion_id": self._name, **fields}, allow_nan=False))

    def hear(self, timeout_s: float) -> Message | None:
        """The next message that matters, None if none came; raises Held for a fault that ends the insertion."""
        try:
            message: Message = json.loads(self._link.recv(timeout_s))
        except TimeoutError:
            return None
        if clock := message.get("clock"):
            self._ahead_ns.append(clock["sent_ns"] - clock["service_ns"])
        if message["type"] == "fault" and (message["fatal"] or message["code"] not in CAMERA_FAULTS):
            cause = "part_lost" if message["code"] == "part_lost" else "service"
            raise Held(cause, f"{message['code']}: {message['detail']}")
        if message["type"] == "finished" and message["outcome"] != "inserted":
            doubts = "; ".join(doubt["detail"] for doubt in message["doubts"])
            raise Held(message["cause"] or "service", f"the insertion ended {message['outcome']}: {doubts}")
        return None if message["type"] == "heartbeat" else message

    def wait(self, *kinds: str, timeout_s: float) -> Message:
        """The next message of one of these kinds; raises Held where none comes in time."""
        until_s = time.monotonic() + timeout_s
        while (left_s := until_s - time.monotonic()) > 0:
            message = self.hear(left_s)
            if message and message["type"] in kinds:
                return message
        raise Held("timeout", f"no {' or '.join(kinds)} within {timeout_s:g} s")

    def age_s(self, captured_ns: int) -> float:
        """How old a frame is at most; raises Held for one that was captured later than now."""
        age_s = (time.monotonic_ns() - captured_ns - max(self._ahead_ns)) / 1e9
        if not age_s > -0.01:
            raise Held("service", f"a frame that will be captured in {-age_s:.2f} s: the clocks contradict each other")
        return age_s

    def beat(self, ended: threading.Event) -> None:
        """Heartbeats until the end, also while the arm moves and nothing is awaited."""
        count = 0
        with contextlib.suppress(ConnectionClosed):
            while not ended.wait(HEARTBEAT_S):
                count += 1
                self.say("heartbeat", count=count, sent_ns=time.monotonic_ns())


def insert(arm: Arm, token: str, task: Task, url: str = URL) -> Message:
    """One insertion from grasp to `finished`, which is returned. On any error the arm stands, and it is raised."""
    with _connected(token, task, url) as service:
        try:
            limits = _greet(service, task)
            service.say("learn_open")
            service.wait("open_learnt", timeout_s=READY_S)
            arm.grasp()
            return _attempts(arm, service, task, limits)
        except BaseException as error:
            arm.stop()
            with contextlib.suppress(ConnectionClosed):
                service.say("abort", cause=_cause(error), reason=str(error)[:512])
            raise


@contextlib.contextmanager
def _connected(token: str, task: Task, url: str) -> Iterator[Service]:
    head, client = {"Authorization": f"Bearer {token}"}, "examples/cell_controller.py"
    with connect(
        url,
        additional_headers=head,
        compression=None,
        open_timeout=READY_S,
        close_timeout=1.0,
        max_queue=None,  # a full one, as in a long call of the arm, would leave the service's pings unanswered
        proxy=None,  # of the environment: none leads to a cell, and none should read the token
    ) as link:
        service, ended = Service(link, task.name), threading.Event()
        beats = threading.Thread(target=service.beat, args=[ended], daemon=True)
        now_ns = time.monotonic_ns()
        service.say("hello", protocol=PROTOCOL, client=client, sent_ns=now_ns, continues=task.continues)
        beats.start()
        try:
            yield service
        finally:
            ended.set()


def _cause(error: BaseException) -> str:
    """An error in the words of `abort`."""
    if isinstance(error, Held):
        return error.cause
    if isinstance(error, KeyboardInterrupt):
        return "operator"
    return "link" if isinstance(error, ConnectionClosed) else "client"


def _greet(service: Service, task: Task) -> Message:
    """The service's limits; raises Held where this descent could not be watched."""
    hello = service.wait("hello", timeout_s=READY_S)
    if hello["protocol"] != PROTOCOL:
        raise Held("service", f"the service speaks protocol {hello['protocol']}, this controller {PROTOCOL}")
    for camera in hello["cameras"]:
        if camera["state"] != "live":
            raise Held("camera", f"the {camera['finger']} camera is {camera['state']}")
        if camera["frame_rate_hz"] and 1.5 / camera["frame_rate_hz"] + 0.02 > task.lease_s:
            raise Held("limits", f"{camera['frame_rate_hz']:.0f} frames a second: too few at {task.speed_mm_s:g} mm/s")
    return dict(hello["limits"])


def _attempts(arm: Arm, service: Service, task: Task, limits: Message) -> Message:
    undecided = 0
    for attempt in range(1, ATTEMPTS + 1):
        answer = _attempt(arm, service, task, attempt)
        if answer["type"] == "finished":
            return answer
        undecided = undecided + 1 if answer["type"] == "no_decision" else 0
        if undecided > MOST_NO_DECISIONS or answer.get("reason") in FINAL_REASONS:
            raise Held("no_decision", f"{answer['reason']}: {answer['detail']}")
        if attempt == ATTEMPTS:
            break  # `finished` follows: hold
        arm.retract()
        if answer["type"] == "correction":
            arm.move_by(_bounded(answer, limits, "dx_mm"), _bounded(answer, limits, "dtheta_deg"))
    raise Held("attempts", f"not inserted after {ATTEMPTS} attempts")


def _bounded(answer: Message, limits: Message, key: str) -> float:
    """A correction's motion; raises Held for one beyond what the service itself said it would ever ask for."""
    value = float(answer[key])
    if not (math.isfinite(value) and abs(value) <= limits[f"max_{key}"]):
        raise Held("limits", f"a correction of {key} = {value:g}, allowed up to {limits[f'max_{key}']:g}")
    return value


def _attempt(arm: Arm, service: Service, task: Task, attempt: int) -> Message:
    """Arm, go down, stop, tell the depth: `finished`, `correction` or `no_decision`."""
    service.say(
        "arm",
        attempt=attempt,
        gap_width_mm=task.gap_width_mm,
        expected_depth_mm=task.depth_mm,
        grasp_height_mm=task.grasp_height_mm,
        gripper_width_mm=arm.width_mm(),
        neighbours_stay=task.neighbours_stay,
    )
    armed = service.wait("armed", "refused", timeout_s=READY_S)
    if armed["type"] == "refused":
        raise Held("refused", _refusal(task, armed))
    touched = _descend(arm, service, task, armed)
    depth_mm = arm.depth_mm()
    outcome = "inserted" if depth_mm >= task.depth_mm - 1.0 else "blocked" if touched else "stopped"
    service.say("stopped", attempt=attempt, depth_mm=depth_mm, outcome=outcome, gripper_width_mm=arm.width_mm())
    if outcome == "inserted":
        return service.wait("finished", timeout_s=FINISHED_S)
    return service.wait("correction", "no_decision", timeout_s=ANSWER_S)


def _refusal(task: Task, refused: Message) -> str:
    """Why nothing went down, and what a person does about what this controller, without a fixture, cannot mend."""
    why = f"{refused['reason']}: {refused['detail']}"
    if refused["reason"] != "turned_in_hand":
        return why
    return f"{why}; put it back upright into the open hand, and insert it with continues={task.name!r}, more slowly"


def _descend(arm: Arm, service: Service, task: Task, armed: Message) -> bool:
    """The guarded descent; whether touch ended it. The arm stands when this returns, and when it raises."""
    attempt, newest_ns = armed["attempt"], armed["frame_captured_ns"]
    service.say("descending", attempt=attempt, speed_mm_s=task.speed_mm_s)
    try:
        arm.descend(task.depth_mm, task.speed_mm_s, _left_s(service, task, newest_ns))
        while arm.descending():
            arm.go_on(_left_s(service, task, newest_ns))
            match service.hear(timeout_s=0.005):
                case {"type": "slip" | "enough"}:
                    return True
                case {"type": "fault"}:
                    return False  # a camera: `no_decision` will say so, and the same spot is probed again
                case {"type": "watching", "attempt": number, "frame_captured_ns": stamp_ns} if number == attempt:
                    newest_ns = max(newest_ns, stamp_ns)
        _left_s(service, task, newest_ns)  # or the arm's watchdog ended it
    finally:
        arm.stop()
    return False


def _left_s(service: Service, task: Task, newest_ns: int) -> float:
    """How long the arm may move on the newest judged frame; raises Held where that time is over."""
    age_s = service.age_s(newest_ns)
    if age_s > task.lease_s:
        raise Held("unwatched", f"the newest judged frame is {age_s * 1e3:.0f} ms old")
    return task.lease_s - age_s
