"""`python -m simulation probe SCENE --x-mm X --theta-deg T`."""

from __future__ import annotations

import argparse

from simulation.probe import run_probe
from simulation.scene import load_scene


def main(arguments: list[str]) -> int:
    """Run one descent and print what happened, frame by frame."""
    parser = argparse.ArgumentParser(prog="python -m simulation probe", description=__doc__)
    parser.add_argument("scene", help="a built-in name (rectangle, circle, ...) or a TOML file")
    parser.add_argument("--x-mm", type=float, default=8.0, help="position error across the gap (default 8)")
    parser.add_argument("--theta-deg", type=float, default=5.0, help="yaw error (default 5)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    probe = run_probe(load_scene(given.scene), given.x_mm, given.theta_deg, seed=given.seed)
    print(
        f"outcome {probe.outcome}; "
        f"onset frame {probe.onset_frame}, slip {probe.true_slip_frame}, stop {probe.stop_frame}"
    )
    print("frame  depth mm  force N  tilt deg  largest shear mm")
    for i, depth in enumerate(probe.depth_mm):
        shear = float(abs(probe.gel[i, ..., :2] - probe.gel[0, ..., :2]).max())
        tilt = 57.29578 * float((probe.in_hand[i, 3:5] ** 2).sum()) ** 0.5
        print(f"{i:5d}  {depth:8.2f}  {probe.wrench[i, 2]:7.2f}  {tilt:8.2f}  {shear:8.3f}")
    return 0
