"""`python -m service replay PATH`: decide a recorded insertion (.mcap) again."""

import json
from collections.abc import Sequence
from pathlib import Path

from service.contract.text import Parser, printable
from service.tools.redecide import redecide


def main(arguments: Sequence[str]) -> int:
    """Decide it again and compare; raises RecordingError or FileNotFoundError on invalid input."""
    parser = Parser(
        prog="tactile-insertion replay",
        description="Decide a recorded insertion again and compare every message bit for bit.",
    )
    parser.add_argument("path", type=Path, help="insertion.mcap of a recording")
    parser.add_argument(
        "--models", type=Path, metavar="DIR", help="folder of the networks that decided it; default the released"
    )
    parser.add_argument("--json", action="store_true", help="print the number of messages and the differing ones")
    options = parser.parse_args(arguments)
    messages_n, differing = redecide(options.path, options.models)
    if options.json:
        print(json.dumps({"same": not differing, "messages_n": messages_n, "differing": differing}))
    else:
        same = f"{messages_n} messages decided again, all the same bit for bit"
        print("\n".join(map(printable, differing)) or same)
    return 1 if differing else 0
