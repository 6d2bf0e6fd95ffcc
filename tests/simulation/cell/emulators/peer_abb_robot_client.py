"""Every public method of abb-robot-client's RWS client, as its own tests call them, against an address: JSON of errors.

Runs as a process of its own: ``python peer_abb_robot_client.py URL``. Prints ``{method: error or null}``.
"""

import inspect
import json
import sys
import time

import numpy as np
from abb_robot_client import rws
from abb_robot_client.rws import JointTarget, RAPIDExecutionState
from abb_robot_client.rws import SubscriptionResourcePriority as Priority
from abb_robot_client.rws import SubscriptionResourceRequest as Resource
from abb_robot_client.rws import SubscriptionResourceType as Kind

JOINTS = JointTarget(np.deg2rad(np.arange(6.0)), np.deg2rad(np.arange(6.0, 12.0)))
KINDS = (
    Resource(Kind.ControllerState, Priority.Medium),
    Resource(Kind.OperationalMode, Priority.Medium),
    Resource(Kind.ExecutionState, Priority.Medium),
    Resource(Kind.PersVar, Priority.High, "peerNumber"),
    Resource(Kind.Elog, Priority.Medium),
    Resource(Kind.Signal, Priority.High, "doSlipStop"),
)


def same(one, other):
    return all(np.allclose(a, b, atol=1e-4) for a, b in zip(one, other, strict=True))


CALLS = (
    ("set_controller_state", ("motoron",), None),
    ("get_controller_state", (), lambda got: got == "motoron"),
    ("get_operation_mode", (), lambda got: got == "AUTO"),
    ("get_tasks", (), lambda got: got["T_ROB1"].motiontask and got["T_ROB1"].active),
    ("activate_task", ("T_ROB1",), None),
    ("start", ("asis", ["T_ROB1"]), None),
    ("get_execution_state", (), lambda got: isinstance(got, RAPIDExecutionState) and got.ctrlexecstate == "running"),
    ("stop", (), None),
    ("deactivate_task", ("T_ROB1",), None),
    ("resetpp", (), None),
    ("get_ramdisk_path", (), bool),
    ("set_digital_io", ("doSlipStop", 1), None),
    ("get_digital_io", ("doSlipStop",), lambda got: got == 1),
    ("set_analog_io", ("aoClampForce", 14.285), None),
    ("get_analog_io", ("aoClampForce",), lambda got: abs(got - 14.285) < 1e-9),
    ("get_rapid_variables", (), lambda got: {"peerNumber", "peerJoints"} <= {entry["name"] for entry in got}),
    ("set_rapid_variable", ("peerNumber", "7"), None),
    ("get_rapid_variable", ("peerNumber",), lambda got: got == "7"),
    ("set_rapid_variable_num", ("peerNumber", 3.5), None),
    ("get_rapid_variable_num", ("peerNumber",), lambda got: got == 3.5),
    ("set_rapid_variable_num_array", ("peerNumbers", [1.5, 2.5]), None),
    ("get_rapid_variable_num_array", ("peerNumbers",), lambda got: got.tolist() == [1.5, 2.5]),
    ("set_rapid_variable_jointtarget", ("peerJoints", JOINTS), None),
    ("get_rapid_variable_jointtarget", ("peerJoints",), lambda got: same(got, JOINTS)),
    ("set_rapid_variable_jointtarget_array", ("peerPath", [JOINTS, JOINTS]), None),
    ("get_rapid_variable_jointtarget_array", ("peerPath",), lambda got: len(got) == 2 and same(got[1], JOINTS)),
    ("upload_file", ("$home/peer.txt", b"hello"), None),
    ("read_file", ("$home/peer.txt",), lambda got: got == b"hello"),
    ("list_files", ("$home",), lambda got: got == ["peer.txt"]),
    ("delete_file", ("$home/peer.txt",), None),
    ("read_event_log", (), lambda got: len(got) > 0 and got[0].title),
    ("get_jointtarget", (), lambda got: got.robax.shape == got.extax.shape == (6,)),
    ("get_robtarget", ("ROB_1", "tool0", "wobj0", "Base"), lambda got: abs(np.linalg.norm(got.rot) - 1) < 1e-6),
    ("set_speedratio", (50,), None),
    ("get_speedratio", (), lambda got: got == 50.0),
    ("try_create_ipc_queue", ("peer",), lambda got: got is True),
    ("get_ipc_queue", ("peer",), bool),
    ("send_ipc_message", ("peer", 'string;"hello"', "peer"), None),
    ("read_ipc_message", ("peer",), lambda got: [m.data for m in got] == ['string;"hello"']),
    ("request_rmmp", (2,), None),
    ("poll_rmmp", (), None),
    ("subscribe", (KINDS,), None),
    ("logout", (), None),
    ("close", (), None),
)


def await_events(events, *kinds):
    """Wait for an event of each of these kinds; raises if one does not come."""
    until_s = time.monotonic() + 20.0
    while missing := set(kinds) - {type(one).__name__ for one in events}:
        assert time.monotonic() < until_s, missing
        time.sleep(0.02)


def subscribed(client):
    """Raises unless a subscription to everything tells that a variable, a signal and both states have changed."""
    events = []
    link = client.subscribe(KINDS, events.append)
    time.sleep(0.5)
    client.set_rapid_variable("peerNumber", str(int(time.time())))
    client.set_digital_io("doSlipStop", 0)
    client.start("asis", ["T_ROB1"])
    await_events(events, "VariableValue", "Signal", "RAPIDExecutionState")
    client.set_controller_state("motoroff")
    await_events(events, "ControllerState")
    link.close()


def called(client, name, arguments, right):
    """None if a method did what it says, else its error in one line."""
    try:
        if name == "subscribe":
            subscribed(client)
            return None
        got = getattr(client, name)(*arguments)
        if name in {"set_controller_state", "start", "stop"}:
            time.sleep(0.6)  # accepted is not done
        return None if right is None or right(got) else f"unexpected answer {got!r}"
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]


def main(url):
    client = rws.RWS(url)
    errors = {name: called(client, name, arguments, right) for name, arguments, right in CALLS}
    public = {name for name, _ in inspect.getmembers(rws.RWS, inspect.isfunction) if not name.startswith("_")}
    print(json.dumps({"errors": errors, "never_called": sorted(public - set(errors))}))


main(sys.argv[1])
