"""Command line of the robot client."""

import argparse
import asyncio
import contextlib
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError
from pydantic_core import to_jsonable_python

from robot_client.cli.alone import alone
from robot_client.cli.check import check
from robot_client.cli.commission import commission
from robot_client.cli.cycle import cycle
from robot_client.cli.doctor import doctor
from robot_client.cli.home import home
from robot_client.cli.insert import insert, make_plan, with_commissioning
from robot_client.cli.jog import jog
from robot_client.cli.terminal import Outcome, printed, show
from robot_client.cli.trial import Subject, try_device
from robot_client.insertion.geometry import WorkPose
from robot_client.ports import NOT_CONFIRMED, DriverError, HomingDirection
from robot_client.session.replay import ReplayError, replay
from robot_client.settings import Settings, load_settings
from service.contract.frames import first_error
from service.contract.refusals import reason
from service.contract.text import Parser, printable
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
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")


def _address(text: str) -> dict[str, Any]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"--gripper {text!r}, expected HOST:PORT")
    return {"host": host, "port": int(port)}


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = Parser(prog="python -m robot_client", description=__doc__, epilog=_EPILOG, formatter_class=raw)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str, *options: Callable[[argparse.ArgumentParser], None]) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("--json", action="store_true", help="print the result as JSON, all other output to stderr")
        for add_options in options:
            add_options(command)
        return command

    add("insert", "insert the held object; a rehearsal without --live", _connection, _mode, _uncommissioned, _insertion)
    summary = "pick, insert and release, part after part; a rehearsal without --live"
    cycling = add("cycle", summary, _connection, _mode, _uncommissioned)
    cycling.add_argument("--parts", type=int, metavar="N", help="stop after N inserted parts (default: never)")
    cycling.add_argument("--logs", type=Path, metavar="DIR", help="folder for episode logs (default runs/robot)")
    summary = "probe from known errors: check the wiring, record data to learn from"
    add("commission", summary, _connection, _mode, _commissioning)
    examining = add("doctor", "name faults of PC, network, controller, gripper and cameras, with remedies", _connection)
    examining.add_argument(
        "--recordings", type=Path, default=Path("recordings"), help="folder of the service's recordings (%(default)s)"
    )
    add("check", "read every device, move nothing, name what is not ready", _connection)
    homing = add("home", "reference the empty gripper", _connection, _mode)
    homing.add_argument(
        "--acknowledge", action="store_true", help="first clear a latched fault, whose cause must be removed"
    )
    homing.add_argument("--direction", choices=get_args(HomingDirection), default="default", help="where it homes")
    jogging = add("jog", "take the TCP to a pose of the work object: up, over, down", _connection, _mode)
    for name, unit in (("x", "mm"), ("y", "mm"), ("z", "mm"), ("theta", "deg")):
        text = "required" if name == "z" else "default 0"
        jogging.add_argument(f"--{name}-{unit}", type=_number, default=0.0, required=name == "z", help=text)
    trying = add("try", "show whether a device's driver keeps the promises of its port", _connection, _mode)
    trying.add_argument("subject", choices=get_args(Subject), help="arm, empty gripper, or gripper with a part")
    log = add("replay", "play an episode log through today's state machine and compare")
    log.add_argument("path", type=Path, help="episode log (JSON lines)")
    return parser


def _insertion(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--x-mm", type=_number, default=0.0, help="start error across the gap (default 0)")
    parser.add_argument("--theta-deg", type=_number, default=0.0, help="start error in yaw (default 0)")
    parser.add_argument("--gap-width-mm", type=_number, help="width of the gap (default 56)")
    parser.add_argument("--expected-depth-mm", type=_number, help="depth of a full insertion below the approach pose")
    parser.add_argument("--creep-allowance-mm", type=_number, help="extra depth for a part pushed up in the hand")
    parser.add_argument("--approach-z-mm", type=_number, help="TCP height of the approach pose (default 35)")
    parser.add_argument("--controller", choices=get_args(ControllerName), help="ask the service for this controller")
    parser.add_argument("--insertion-id", help="name of this insertion (default: time and a random suffix)")
    parser.add_argument("--log", type=Path, help="episode log to write (default runs/robot/INSERTION.jsonl)")


def _mode(parser: argparse.ArgumentParser) -> None:
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--live", action="store_true", help="connect and MOVE")
    mode.add_argument("--dry-run", action="store_true", help="connect nothing, move nothing (the default)")


def _commissioning(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--probes",
        type=int,
        default=150,
        metavar="N",
        help="probes in all, with those of wiring and the presses (150)",
    )
    text = "press at the set grip alone, not also at half or twice of it: for a part that would fall, or break"
    parser.add_argument("--one-grip", action="store_true", help=text)
    parser.add_argument("--seed", type=int, default=0, help="seed of a new record's known errors (default 0)")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/commissioning"), help="folder of the record (%(default)s)"
    )


def _uncommissioned(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--uncommissioned", action="store_true", help="insert in a cell without a passed commissioning")


def _connection(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, help="TOML configuration; see robot_client/README.md")
    parser.add_argument("--service", metavar="URL", help="ws://HOST:PORT/PATH of the decision service")
    parser.add_argument("--egm-port", type=int, help="UDP port to listen on (the controller's UCdevice sends to it)")
    parser.add_argument("--rws-url", metavar="URL", help="http://HOST[:PORT] of the controller")
    parser.add_argument("--gripper", metavar="HOST:PORT", help="address of the gripper")


_TASK = ("gap_width_mm", "expected_depth_mm", "creep_allowance_mm", "approach_z_mm")


def _run(args: argparse.Namespace) -> Outcome:
    if args.command == "replay":
        return _replayed(args.path)
    overrides = {
        "service": {"url": args.service},
        "robot": {"port": args.egm_port, "rws": {"url": args.rws_url}},
        "gripper": {} if args.gripper is None else _address(args.gripper),
        "task": {key: getattr(args, key, None) for key in _TASK},
    }
    if args.command == "doctor":
        return doctor(args.config, overrides, args.recordings)
    live = getattr(args, "live", False)
    if live and args.config is None:
        raise ValueError(
            "--live expects --config FILE: the limits and addresses that are built in are those of no cell"
        )
    settings = load_settings(args.config, overrides)
    with alone(settings) if live else contextlib.nullcontext():
        return _on_cell(args, settings)


def _replayed(path: Path) -> Outcome:
    state = replay(path, show)
    return Outcome(True, {"phase": str(state.phase), "attempts": state.attempt, "reason": state.reason})


def _on_devices(args: argparse.Namespace, settings: Settings) -> Outcome:
    if args.command == "check":
        return check(settings)
    if args.command == "home":
        return home(settings, acknowledge=args.acknowledge, direction=args.direction, live=args.live)
    if args.command == "try":
        return try_device(settings, args.subject, live=args.live)
    target = WorkPose(x_mm=args.x_mm, y_mm=args.y_mm, z_mm=args.z_mm, yaw_deg=args.theta_deg)
    return jog(settings, target, live=args.live)


def _on_cell(args: argparse.Namespace, settings: Settings) -> Outcome:
    if args.command in ("check", "home", "jog", "try"):
        return _on_devices(args, settings)
    if args.command == "commission":
        if args.probes < 0:
            raise ValueError(f"--probes {args.probes}: expected 0 or more")
        if args.seed < 0:
            raise ValueError(f"--seed {args.seed}: expected 0 or more")
        how = {"probes_n": args.probes, "one_grip": args.one_grip, "seed": args.seed, "out": args.out}
        return commission(settings, live=args.live, **how)
    if args.command == "cycle":
        if args.parts is not None and args.parts < 1:
            raise ValueError(f"--parts {args.parts}: expected 1 or more")
        return cycle(
            settings,
            live=args.live,
            asked=not args.uncommissioned,
            parts_n=args.parts,
            log=args.logs or Path("runs") / "robot",
        )
    plan = make_plan(settings, args.x_mm, args.theta_deg, args.insertion_id, args.controller)
    if args.live:
        plan = with_commissioning(settings, plan, asked=not args.uncommissioned)
    log = args.log or Path("runs") / "robot" / f"{plan.insertion_id}.jsonl"
    if log.exists():
        raise ValueError(f"--log {log} exists already; episode logs are never overwritten")
    return insert(settings, plan, live=args.live, log=log)


def _json(result: dict[str, Any]) -> str:
    """Its text, whatever a driver's statistics hold: null for a number that is none, text for what JSON lacks."""
    return json.dumps(to_jsonable_python(result, inf_nan_mode="null", bytes_mode="hex", fallback=str), allow_nan=False)


def main(argv: list[str] | None = None) -> int:
    """Run one command: 0 done, 1 not done, 2 invalid input, with one line on stderr."""
    args = _parser().parse_args(argv)
    try:
        with contextlib.redirect_stdout(sys.stderr) if args.json else contextlib.nullcontext():
            try:
                outcome = _run(args)
            finally:
                with contextlib.suppress(KeyboardInterrupt):  # the work is over: how it ended is not "nothing moves"
                    printed()
        code = 0 if outcome.done else 1
    except (ValueError, OSError) as error:  # OSError: of a device's driver
        text = first_error(error) if isinstance(error, ValidationError) else reason(error)
        prefix = "FAILED SAFE" if isinstance(error, DriverError | OSError) else "error"
        prefix = "FAILED" if NOT_CONFIRMED in text else prefix
        print(printable(f"{prefix}: {text}"), file=sys.stderr)
        code = 1 if isinstance(error, DriverError | OSError | ReplayError) else 2
        outcome = Outcome(False, {"error": text})
    except (KeyboardInterrupt, asyncio.CancelledError):
        print("interrupted, nothing moves", file=sys.stderr)
        code, outcome = 1, Outcome(False, {"error": "interrupted"})
    if args.json:
        show(_json({"done": outcome.done, **outcome.result}), whole=True)
    return code
