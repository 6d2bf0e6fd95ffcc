"""`python -m service replay PATH`: perception over a clip, or a recorded insertion (.mcap) decided again."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from service.contract import FINGERS


def main(arguments: Sequence[str]) -> int:
    """Replay a recording; raises ReplayError, RecordingError or FileNotFoundError on bad input."""
    options = vars(_parse(arguments))
    models = options.pop("models")
    if options["path"].suffix == ".mcap":
        from service.tools.redecide import redecide

        return redecide(options["path"], models)
    from service.tools.replay import ReplayOptions, clips_of, replay

    crop = options.pop("crop")
    chosen = ReplayOptions(crop=None if crop is None else tuple(crop), **options)
    for clip in clips_of(chosen.path):
        replay(clip, chosen)
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="tactile-insertion replay",
        description="Run marker tracking and slip detection over a clip, print what happened when, and draw it. "
        "A recorded insertion (.mcap) is decided again instead and compared bit for bit.",
        epilog="example: tactile-insertion replay clip.avi --fps 30 --plot --out runs/replay",
    )
    parser.add_argument("path", type=Path, help="a .mcap, a video, a folder of frames (png, jpg) or of videos")
    parser.add_argument(
        "--models", type=Path, metavar="DIR", help="of a .mcap: the models, where they lie elsewhere now"
    )
    parser.add_argument("--plot", action="store_true", help="write the annotated video too")
    parser.add_argument("--out", type=Path, default=Path("runs/replay"), help="folder for the pictures (%(default)s)")
    parser.add_argument(
        "--crop", type=int, nargs=4, metavar=("LEFT", "TOP", "WIDTH", "HEIGHT"), help="where the gel is, in pixels"
    )
    parser.add_argument("--fps", type=float, help="frames a second at capture, where the file's header is wrong")
    parser.add_argument("--calibration", type=Path, help="rectify the frames with this file first")
    parser.add_argument("--untouched", action="store_true", help="nothing touches the gel in the first frame: learn it")
    parser.add_argument("--finger", choices=FINGERS, default="left", help="whose calibration to use (%(default)s)")
    return parser.parse_args(arguments)
