"""`python -m service COMMAND`: a command is a module of :mod:`service.cli`, loaded only on use."""

import importlib
import os
import sys
from collections.abc import Sequence

COMMANDS = {
    "run": "serve: cameras in, slip and corrections out, dashboard at /",
    "replay": "decide a recorded insertion (.mcap) again",
    "calibrate": "fit the rectification of a camera from frames of a resting gel",
    "judge": "find contact, hold, slip and loss in recorded grasps, run by run",
    "models": "check a folder of models and print their cards",
    "versions": "show, promote or roll back the versions of a running service",
}
EXIT_BAD_INPUT = 2


def usage() -> str:
    """The help text: one line per command."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        ["usage: python -m service COMMAND [options]", "", *lines, "", "python -m service COMMAND --help tells more."]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; exit code 2 and one line on standard error if its input is invalid."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in {"-h", "--help"}:
        print(usage())
        return 0 if arguments else EXIT_BAD_INPUT
    name, *rest = arguments
    for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(pool, "1")  # our own threads work on small matrices; pools would only spin
    if name not in COMMANDS:
        from service.contract.refusals import nearest

        print(f"service: unknown command {name!r}{nearest(name, COMMANDS)}", file=sys.stderr)
        return EXIT_BAD_INPUT
    from service.contract.text import run_command

    return run_command(f"service {name}", lambda: int(importlib.import_module(f"service.cli.{name}").main(rest)))


if __name__ == "__main__":
    sys.exit(main())
