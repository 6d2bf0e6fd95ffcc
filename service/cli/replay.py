"""`python -m service replay PATH`: a recorded insertion (.mcap) decided again."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from service.tools.redecide import redecide


def main(arguments: Sequence[str]) -> int:
    """Decide it again and compare; raises RecordingError or FileNotFoundError on bad input."""
    parser = argparse.ArgumentParser(
        prog="tactile-insertion replay",
        description="Decide a recorded insertion again and compare every message bit for bit.",
    )
    parser.add_argument("path", type=Path, help="insertion.mcap of a recording")
    parser.add_argument("--models", type=Path, metavar="DIR", help="the models, where they lie elsewhere now")
    options = parser.parse_args(arguments)
    return redecide(options.path, options.models)
