"""Unmodified abb-robot-client (RWS and EGM) as a user of it would write: argv is the RWS url and the EGM port."""

import sys
import time

import numpy as np
from abb_robot_client.egm import EGM
from abb_robot_client.rws import RWS

url, port = sys.argv[1], int(sys.argv[2])
rws = RWS(url)
assert rws.get_operation_mode() == "AUTO"
assert rws.get_controller_state() == "motoroff"
egm = EGM(port)
rws.set_controller_state("motoron")
while rws.get_controller_state() != "motoron":
    time.sleep(0.02)
assert "T_ROB1" in rws.get_tasks()
rws.start()
good, state, tries = False, None, 0
while not good and tries < 100:
    good, state = egm.receive_from_robot(timeout=0.1)
    tries += 1
assert good
assert state.motors_on
position, orientation = state.cartesian
target = np.array(position) + np.array([0.0, 0.0, 2.0])
sent, until = 0, time.monotonic() + 30.0
while time.monotonic() < until:
    good, state = egm.receive_from_robot(timeout=0.1)
    if good:
        share = min(1.0, sent / 250.0)
        egm.send_to_robot_cart(position + (target - position) * share, orientation)
        sent += 1
        if share == 1.0 and np.linalg.norm(state.cartesian[0] - target) < 0.02:
            break
assert np.linalg.norm(state.cartesian[0] - target) < 0.02, state.cartesian
assert state.joint_angles.size == 6
rws.stop()
while rws.get_execution_state().ctrlexecstate != "stopped":
    time.sleep(0.02)
pose = rws.get_robtarget(tool="tool0", wobj="wobj0")
assert len(rws.read_event_log()) > 0
egm.close()
rws.logout()
print(f"followed {sent} targets")
