"""Command line of the robot client: ``python -m robot_client insert|...``; see ``--help``."""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from robot_client.settings import Settings, load_settings
from service.contract.frames import first_error

_EPILOG = """exit codes: 0 inserted (or done), 1 not inserted or failed safe, 2 wrong input or configuration

examples:
  python -m robot_client insert --x-mm 8 --theta-deg 6                        rehearse, nothing connected
  python -m robot_client check --config cell.toml                             read the devices, move nothing
  python -m robot_client insert --live --config cell.toml --x-mm 8 --theta-deg 6
  python -m robot_client replay runs/robot/INSERTION.jsonl
"""


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m robot_client", description=__doc__, epilog=_EPILOG, formatter_class=raw
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_insert(commands.add_parser("insert", help="insert the held object; a rehearsal unless --live is typed"))
    check = commands.add_parser("check", help="read every device, move nothing, say what is not ready")
    _add_connection(check)
    home = commands.add_parser("home", help="reference the empty gripper")
    _add_connection(home)
    _add_mode(home)
    home.add_argument("--acknowledge", action="store_true", help="first clear a latched fault whose cause you removed")
    home.add_argument("--direction", choices=("default", "outward", "inward"), default="default", help="end stop")
    jog = commands.add_parser("jog", help="take the TCP to a pose of the work object: up, over, down")
    _add_connection(jog)
    _add_mode(jog)
    for name, unit in (("x", "mm"), ("y", "mm"), ("z", "mm"), ("theta", "deg")):
        text = "required" if name == "z" else "default 0"
        jog.add_argument(f"--{name}-{unit}", type=_number, default=0.0, required=name == "z", help=text)
    replay = commands.add_parser("replay", help="tell an episode log again and compare it with today's state machine")
    replay.add_argument("path", type=Path, help="episode log (JSON lines)")
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
    insert.add_argument("--controller", choices=("heuristic", "belief"), help="ask the service for this controller")
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
    parser.add_argument("--gripper", metavar="HOST:PORT", help="WSG-50, binary protocol over TCP")


_TASK = ("gap_width_mm", "expected_depth_mm", "creep_allowance_mm", "approach_z_mm")


def _overrides(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    gripper: dict[str, Any] = {}
    if args.gripper is not None:
        host, separator, port = args.gripper.rpartition(":")
        if not separator or not host or not port.isdigit():
            raise ValueError(f"--gripper {args.gripper!r}, expected HOST:PORT")
        gripper = {"host": host, "port": int(port)}
    task = {key: getattr(args, key, None) for key in _TASK}
    return {
        "service": {"url": args.service},
        "egm": {"port": args.egm_port},
        "rws": {"url": args.rws_url},
        "gripper": gripper,
        "task": task,
    }


def _insert(args: argparse.Namespace, settings: Settings) -> int:
    from robot_client.cli.insert import insert, make_plan

    plan = make_plan(settings, args.x_mm, args.theta_deg, args.insertion_id, args.controller)
    log = args.log or Path("runs") / "robot" / f"{plan.insertion_id}.jsonl"
    if log.exists():
        raise ValueError(f"--log {log} exists already; episode logs are never overwritten")
    return insert(settings, plan, live=args.live, log=log)


def _check(_args: argparse.Namespace, settings: Settings) -> int:
    from robot_client.cli.check import check

    return check(settings)


def _home(args: argparse.Namespace, settings: Settings) -> int:
    from robot_client.cli.jog import home
    from robot_client.grippers.wsg50.codec import HomingDirection

    direction = HomingDirection[args.direction.upper()]
    return home(settings, acknowledge=args.acknowledge, direction=direction, live=args.live)


def _jog(args: argparse.Namespace, settings: Settings) -> int:
    from robot_client.cli.jog import jog
    from robot_client.insertion.geometry import WorkPose

    target = WorkPose(x_mm=args.x_mm, y_mm=args.y_mm, z_mm=args.z_mm, yaw_deg=args.theta_deg)
    return jog(settings, target, live=args.live)


_COMMANDS = {"insert": _insert, "check": _check, "home": _home, "jog": _jog}


def _run(args: argparse.Namespace) -> int:
    if args.command == "replay":
        from robot_client.session.replay import replay

        replay(args.path)
        return 0
    return _COMMANDS[args.command](args, load_settings(args.config, _overrides(args)))


def main(argv: list[str] | None = None) -> int:
    """Run one command; wrong input is one line on stderr and exit code 2."""
    args = _parser().parse_args(argv)
    try:
        return _run(args)
    except ValueError as error:
        from robot_client.ports import DriverError

        said = first_error(error) if isinstance(error, ValidationError) else str(error)
        print(f"{'FAILED SAFE' if isinstance(error, DriverError) else 'error'}: {said}", file=sys.stderr)
        return 1 if isinstance(error, DriverError) else 2
