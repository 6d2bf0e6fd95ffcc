"""Command line of the robot client."""

import argparse
import contextlib
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from robot_client.cli.terminal import Outcome, show
from robot_client.ports import DriverError, HomingDirection
from robot_client.session.replay import ReplayError, replay
from robot_client.settings import Settings, load_settings
from service.contract.frames import first_error
from service.contract.wire import ControllerName

_EPILOG = """exit codes: 0 done (inserted, ready, homed, ...), 1 not done or failed safe,
2 wrong input or configuration

examples (m is python -m robot_client):
  m insert --x-mm 8 --theta-deg 6            rehearse, nothing connected
  m check --config cell.toml                 read the devices, move nothing
  m insert --live --config cell.toml --x-mm 8 --theta-deg 6
  m replay runs/robot/INSERTION.jsonl
"""


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def _address(text: str) -> dict[str, Any]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"--gripper {text!r}, expected HOST:PORT")
    return {"host": host, "port": int(port)}


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m robot_client", description=__doc__, epilog=_EPILOG, formatter_class=raw
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Callable[[argparse.Namespace], Outcome], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("--json", action="store_true", help="print the result as JSON, all else to stderr")
        command.set_defaults(run=run)
        return command

    _add_insert(add("insert", _insert, "insert the held object; a rehearsal unless --live is typed"))
    _add_connection(add("check", _check, "read every device, move nothing, name what is not ready"))
    home = add("home", _home, "reference the empty gripper")
    _add_connection(home)
    _add_mode(home)
    home.add_argument("--acknowledge", action="store_true", help="first clear a latched fault; remove its cause before")
    home.add_argument("--direction", choices=get_args(HomingDirection), default="default", help="end stop")
    jog = add("jog", _jog, "take the TCP to a pose of the work object: up, over, down")
    _add_connection(jog)
    _add_mode(jog)
    for name, unit in (("x", "mm"), ("y", "mm"), ("z", "mm"), ("theta", "deg")):
        text = "required" if name == "z" else "default 0"
        jog.add_argument(f"--{name}-{unit}", type=_number, default=0.0, required=name == "z", help=text)
    log = add("replay", _replay, "play an episode log through today's state machine and compare")
    log.add_argument("path", type=Path, help="episode log (JSON lines)")
    return parser


def _add_insert(insert: argparse.ArgumentParser) -> None:
    _add_connection(insert)
    _add_mode(insert)
    insert.add_argument("--x-mm", type=_number, default=0.0, help="start error across the gap (default 0)")
    insert.add_argument("--theta-deg", type=_number, default=0.0, help="start error in yaw (default 0)")
    insert.add_argument("--gap-width-mm", type=_number, help="width of the gap (default 56)")
    insert.add_argument("--expected-depth-mm", type=_number, help="depth of a full insertion below the approach pose")
    insert.add_argument("--creep-allowance-mm", type=_number, help="how much deeper for a part pushed up in the hand")
    insert.add_argument("--approach-z-mm", type=_number, help="TCP height of the approach pose (default 35)")
    insert.add_argument("--controller", choices=get_args(ControllerName), help="ask the service for this controller")
    insert.add_argument("--insertion-id", help="name of this insertion (default: time and a random suffix)")
    insert.add_argument("--log", type=Path, help="episode log to write (default runs/robot/INSERTION.jsonl)")


def _add_mode(parser: argparse.ArgumentParser) -> None:
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--live", action="store_true", help="connect and MOVE")
    mode.add_argument("--dry-run", action="store_true", help="connect nothing, move nothing (the default)")


def _add_connection(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, help="TOML configuration; see robot_client/README.md")
    parser.add_argument("--service", metavar="URL", help="ws://HOST:PORT/PATH of the decision service")
    parser.add_argument("--egm-port", type=int, help="UDP port we listen on (the controller's UCdevice sends to it)")
    parser.add_argument("--rws-url", metavar="URL", help="http://HOST[:PORT] of the controller")
    parser.add_argument("--gripper", metavar="HOST:PORT", help="where the gripper is")


_TASK = ("gap_width_mm", "expected_depth_mm", "creep_allowance_mm", "approach_z_mm")


def _settings(args: argparse.Namespace) -> Settings:
    overrides = {
        "service": {"url": args.service},
        "robot": {"port": args.egm_port, "rws": {"url": args.rws_url}},
        "gripper": {} if args.gripper is None else _address(args.gripper),
        "task": {key: getattr(args, key, None) for key in _TASK},
    }
    return load_settings(args.config, overrides)


def _insert(args: argparse.Namespace) -> Outcome:
    from robot_client.cli.insert import insert, make_plan

    settings = _settings(args)
    plan = make_plan(settings, args.x_mm, args.theta_deg, args.insertion_id, args.controller)
    log = args.log or Path("runs") / "robot" / f"{plan.insertion_id}.jsonl"
    if log.exists():
        raise ValueError(f"--log {log} exists already; episode logs are never overwritten")
    return insert(settings, plan, live=args.live, log=log)


def _check(args: argparse.Namespace) -> Outcome:
    from robot_client.cli.check import check

    return check(_settings(args))


def _home(args: argparse.Namespace) -> Outcome:
    from robot_client.cli.home import home

    return home(_settings(args), acknowledge=args.acknowledge, direction=args.direction, live=args.live)


def _jog(args: argparse.Namespace) -> Outcome:
    from robot_client.cli.jog import jog
    from robot_client.insertion.geometry import WorkPose

    target = WorkPose(x_mm=args.x_mm, y_mm=args.y_mm, z_mm=args.z_mm, yaw_deg=args.theta_deg)
    return jog(_settings(args), target, live=args.live)


def _replay(args: argparse.Namespace) -> Outcome:
    state = replay(args.path, show)
    return Outcome(True, {"phase": str(state.phase), "attempts": state.attempt, "reason": state.reason})


def main(argv: list[str] | None = None) -> int:
    """Run one command: 0 done, 1 not done, 2 wrong input, which is one line on stderr."""
    args = _parser().parse_args(argv)
    try:
        with contextlib.redirect_stdout(sys.stderr) if args.json else contextlib.nullcontext():
            outcome = args.run(args)
        code = 0 if outcome.done else 1
    except ValueError as error:
        text = first_error(error) if isinstance(error, ValidationError) else str(error)
        prefix = "FAILED SAFE" if isinstance(error, DriverError) else "error"
        print(f"{prefix}: {text}", file=sys.stderr)
        code = 1 if isinstance(error, DriverError | ReplayError) else 2
        outcome = Outcome(False, {"error": text})
    except KeyboardInterrupt:
        code, outcome = 1, Outcome(False, {"error": "interrupted"})
    if args.json:
        show(json.dumps({"done": outcome.done, **outcome.result}))
    return code
