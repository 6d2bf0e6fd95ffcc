"""The emulated controller's answers to GET: one function per family of resources, as typed states."""

from collections.abc import Mapping

from simulation.cell.emulators.abb.cabinet import Cabinet
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.rws_format import State

TASK, UNIT = "T_ROB1", "ROB_1"
SYSTEM = [
    State("sys-system-li", "system", {"major": "6", "minor": "13", "rwversion": "6.13.00.00", "name": "TactileCell"}),
    State("sys-option-li", "0", {"option": "689-1 Externally Guided Motion (EGM)"}),
    State("sys-option-li", "1", {"option": "616-1 PC Interface"}),
]
_JOINTS = tuple(f"rax_{k}" for k in range(1, 7))
_NO_AXES = "abcdef"
_UNDEFINED = "9E+09"


def panel(cabinet: Cabinet, what: str) -> list[State]:
    """``ctrlstate``, ``opmode`` or ``speedratio``; raise KeyError for another name."""
    values: dict[str, object] = {
        "ctrlstate": cabinet.state,
        "opmode": cabinet.board.faults.robot.mode,
        "speedratio": cabinet.speed_ratio,
    }
    return [State(f"pnl-{what}", what, {what: str(values[what])})]


def execution(cabinet: Cabinet) -> list[State]:
    fields = {"ctrlexecstate": "running" if cabinet.running else "stopped", "cycle": cabinet.cycle}
    return [State("rap-execution", "execution", fields)]


def tasks(cabinet: Cabinet) -> list[State]:
    fields = {
        "name": TASK,
        "type": "normal",
        "taskstate": "linked",
        "excstate": "started" if cabinet.running else "ready",
        "active": "On",
        "motiontask": "TRUE",
    }
    return [State("rap-task-li", TASK, fields)]


def motion(cabinet: Cabinet, frames: CellFrames, what: str, query: Mapping[str, str]) -> list[State]:
    """``jointtarget``, ``robtarget`` (in the base unless a work object is asked for) or ``cartesian``.

    External axes are ``eax_a`` to ``eax_f``, as the reference and abb_librws name them. In a robtarget as JSON of
    generation 1.0 they are ``eaxa`` to ``eaxf``, as abb-robot-client reads them from a controller.
    """
    pose = cabinet.arm.pose
    if what == "jointtarget":
        joints = frames.joints_deg(pose) or (0.0,) * 6
        fields = {name: f"{value:.6f}" for name, value in zip(_JOINTS, joints, strict=True)}
        return [State("ms-jointtarget", UNIT, fields | {f"eax_{axis}": _UNDEFINED for axis in _NO_AXES})]
    if what not in ("robtarget", "cartesian"):
        raise KeyError(what)
    in_work_object = query.get("wobj", "wobj0") != "wobj0" or query.get("coordinate", "Base").lower() == "wobj"
    shown = pose if in_work_object else frames.in_base(pose)
    fields = {name: f"{value:.4f}" for name, value in zip("xyz", shown.position_mm, strict=True)}
    fields |= {f"q{k}": f"{value:.9f}" for k, value in enumerate(shown.quaternion, 1)}
    fields |= {"cf1": "0", "cf4": "0", "cf6": "0", "cfx": "0"}
    prefix = "eax" if query.get("json") == "1" else "eax_"
    return [State("ms-robtargets", UNIT, fields | {f"{prefix}{axis}": _UNDEFINED for axis in _NO_AXES})]


def signal(cabinet: Cabinet, path: str) -> list[State]:
    """One signal by its last path part; raise KeyError if there is none."""
    name = path.rsplit("/", 1)[-1]
    value = cabinet.signals[name]
    kind = name[:2].upper()  # di, do, ao
    fields = {"name": name, "type": kind, "category": "", "lvalue": f"{value:g}", "lstate": "not simulated"}
    return [State("ios-signal", path, fields)]


def event_log(cabinet: Cabinet, domain: str) -> list[State]:
    return [
        State(
            "elog-message-li",
            f"/rw/elog/{domain}/{entry.number}",
            {
                "msgtype": str(entry.kind),
                "code": str(entry.code),
                "tstamp": entry.stamp,
                "title": entry.title,
                "desc": entry.title,
                "conseqs": "",
                "causes": "",
                "actions": "",
                "argc": "0",
                "argv": [],
            },
        )
        for entry in reversed(cabinet.log)
    ]
