"""Commands that show what happens in one poke of the simulated cell and what its sensor records."""

import math
from pathlib import Path

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from service.contract import FINGERS
from service.contract.text import Parser
from simulation.cell.options import CellOptions
from simulation.data.probe import Probe, run_probe
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.scene import Scene
from simulation.scene.worlds import load_scene
from simulation.studies import imprint as study


def pictures(scene: Scene, probe: Probe, seed: int) -> list[NDArray[np.uint8]]:
    """Rectified frames of both fingers side by side, uint8 [H, 2 W, 3] BGR, one per kept frame."""
    renderers = [Renderer(Appearance.draw(scene, finger, seed)) for finger in FINGERS]
    out = []
    for i, gel in enumerate(probe.gel.astype(np.float32)):
        previous = probe.gel[max(i - 1, 0)].astype(np.float32)
        pair = [one.rectified(gel[k], 2 * i + k, previous[k]) for k, one in enumerate(renderers)]
        out.append(np.concatenate(pair, axis=1))
    return out


def check_name(path: Path) -> None:
    """Raise ValueError for a name or a folder that :func:`save` cannot take."""
    if path.suffix not in (".png", ".mp4"):
        raise ValueError(f"--save: expected a name ending in .png or .mp4, got {path}")
    if not path.parent.is_dir():
        raise ValueError(f"--save: {path} cannot be written: no folder {path.parent}")


def save(frames: list[NDArray[np.uint8]], path: Path, fps: float) -> None:
    """Save the last frame as .png, or all as .mp4. Raises ValueError where writing fails."""
    if path.suffix == ".png":
        if not cv2.imwrite(str(path), frames[-1]):
            raise ValueError(f"--save: {path} cannot be written")
        return
    height, width = frames[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
    if not video.isOpened():
        raise ValueError(f"--save: {path} cannot be written")
    for frame in frames:
        video.write(frame)
    video.release()


def probe(arguments: list[str]) -> int:
    """Run one descent and print what happened, frame by frame."""
    parser = Parser(prog="tactile-insertion probe", description=probe.__doc__)
    parser.add_argument("scene", help="name of an object (rectangle, circle, ...) or a TOML file")
    parser.add_argument("--x-mm", type=float, default=8.0, help="position error across the gap (default 8)")
    parser.add_argument("--theta-deg", type=float, default=5.0, help="yaw error (default 5)")
    parser.add_argument("--seed", type=int, default=0, help="of grasp, optics and noise (default 0)")
    parser.add_argument("--tier", choices=("bristle", "layer"), help="pads to press with (default: the scene's)")
    parser.add_argument("--save", type=Path, help="both fingers' frames: last one as .png or all as .mp4")
    given = parser.parse_args(arguments)
    if given.save is not None:
        check_name(given.save)
    CellOptions(x_mm=given.x_mm, theta_deg=given.theta_deg).check()
    scene = load_scene(given.scene, **({"gel__tier": given.tier} if given.tier else {}))
    done = run_probe(scene, given.x_mm, given.theta_deg, seed=given.seed)
    print(
        f"outcome {done.outcome}; onset frame {done.onset_frame}, slip {done.true_slip_frame}, stop {done.stop_frame}"
    )
    print("frame  depth mm  force N  tilt deg  largest shear mm")
    for i, depth in enumerate(done.depth_mm):
        shear = float(abs(done.gel[i, ..., :2] - done.gel[0, ..., :2]).max())
        tilt = math.degrees(math.hypot(*done.in_hand[i, 3:5]))
        print(f"{i:5d}  {depth:8.2f}  {done.wrench[i, 2]:z7.2f}  {tilt:8.2f}  {shear:8.3f}")
    if given.save is not None:
        save(pictures(scene, done, given.seed), given.save, scene.fps)
        print(f"saved {given.save}")
    return 0


def imprint(arguments: list[str]) -> int:
    """Draw what the simulated sensor records, object by object, as one picture."""
    options = tyro.cli(study.Options, args=arguments, prog="tactile-insertion imprint")
    study.draw(options)
    print(options.out)
    return 0
