"""Unmodified ABBRobotEGM guiding the arm up by 2 mm: argv is the EGM port."""

import sys
import time

import numpy as np
from ABBRobotEGM import EGM

port = int(sys.argv[1])
with EGM(port=port) as egm:
    print("listening", flush=True)
    good, state = egm.receive_from_robot(timeout=20.0)
    assert good
    start = state.cartesian
    position = np.array([start.pos.x, start.pos.y, start.pos.z])
    orientation = np.array([start.orient.u0, start.orient.u1, start.orient.u2, start.orient.u3])
    target = position + np.array([0.0, 0.0, 2.0])
    here, sent, until = position, 0, time.monotonic() + 30.0
    while time.monotonic() < until:
        good, state, _ = egm.receive_latest(timeout=0.1)
        if good:
            share = min(1.0, sent / 250.0)
            egm.send_to_robot_cart(position + (target - position) * share, orientation)
            sent += 1
            here = np.array([state.cartesian.pos.x, state.cartesian.pos.y, state.cartesian.pos.z])
            if share == 1.0 and np.linalg.norm(here - target) < 0.02:
                break
    assert np.linalg.norm(here - target) < 0.02, here
    assert state.motors_on
    assert state.rapid_running
print(f"followed {sent} targets")
