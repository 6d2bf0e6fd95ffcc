"""The cell as a whole: ground truth, faults over HTTP, ports, and a dropped object."""

import socket
from pathlib import Path

import httpx
import pytest

from robot_client.grippers.wsg50.codes import Command
from simulation.cell.emulators.faults import FaultBoard, FaultError
from simulation.cell.emulators.net import BusyPortError
from simulation.cell.live import LiveCell, bind_all
from simulation.cell.options import CellError, CellOptions
from simulation.cell.plant import build
from simulation.scene.worlds import load_scene
from tests.simulation.physics.bench import WsgClient, bench


@pytest.fixture(scope="module")
def cell():
    with bench() as made:
        gripper = WsgClient(made.description["gripper"])
        gripper.do(Command.GRASP, 80.0, 400.0)
        gripper.close()
        yield made


def test_truth_tells_pose_error_and_wires(cell):
    cell.wait(lambda: cell.cell.world.state is not None)
    truth = httpx.get(cell.description["admin_url"] + "/truth").json()
    assert truth["object"]["x_mm"] == pytest.approx(8.0)
    assert truth["object"]["theta_deg"] == pytest.approx(6.0)
    assert truth["controller"]["state"] == "motoroff"
    assert truth["gripper"]["held"]


def test_faults_are_set_read_and_cleared_over_http(cell):
    url = cell.description["admin_url"] + "/faults"
    assert httpx.post(url, json={"egm": {"drop_share": 0.5}}).json()["egm"]["drop_share"] == 0.5
    assert httpx.get(url).json()["egm"]["drop_share"] == 0.5
    assert httpx.delete(url).json()["egm"]["drop_share"] == 0.0
    refused = httpx.post(url, json={"egm": {"drop_share": 2.0}})
    assert refused.status_code == 422
    assert "drop_share" in refused.json()["error"]


@pytest.mark.parametrize("changes", [{"robot": {"nonsense": True}}, {"nothing": {}}, {"egm": 3}])
def test_unknown_faults_are_refused_and_change_nothing(changes):
    board = FaultBoard()
    with pytest.raises(FaultError):
        board.update({"rws": {"refuse_next": 3}} | changes)
    assert board.faults.rws.refuse_next == 0


def test_a_busy_port_is_one_clear_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(BusyPortError, match=f"gripper cannot have port {port}"):
            bind_all(CellOptions(gripper_port=port))


def test_the_client_is_told_to_go_as_deep_as_the_scene_counts_as_inserted():
    scene, options = load_scene("rectangle", blocks__insertion_depth_mm=30.0), CellOptions()
    cell = LiveCell(options, build(scene, options), bind_all(options))
    assert cell.description(Path("none"))["expected_depth_mm"] == scene.full_depth_mm
    for sock in cell.sockets:
        sock.close()


@pytest.mark.parametrize("wrong", [{"fps": 31}, {"x_mm": float("nan")}, {"egm_lag_ms": 0.0}, {"rws_port": 70000}])
def test_a_cell_that_cannot_be_is_refused_by_name(wrong):
    with pytest.raises(CellError, match=next(iter(wrong)).replace("_", "-")):
        CellOptions(**wrong).check()


def test_an_object_let_go_away_from_its_fixture_cannot_be_grasped_again(cell):
    gripper = WsgClient(cell.description["gripper"])
    gripper.do(Command.RELEASE, 100.0, 400.0)
    cell.wait(lambda: not cell.cell.world.held)
    assert cell.cell.part.width_mm() == 80.0  # the arm stands at the fixture
    gripper.do(Command.GRASP, 80.0, 400.0)
    cell.wait(lambda: cell.cell.world.held)
    arm = cell.cell.cabinet.arm
    x, y, z = arm.pose.position_mm
    cell.call(setattr, arm, "pose", type(arm.pose)((x, y, z + 20.0), arm.pose.quaternion))
    gripper.do(Command.RELEASE, 100.0, 400.0)
    cell.wait(lambda: not cell.cell.world.held)
    assert cell.cell.part.width_mm() is None
    gripper.close()


def test_physics_without_equilibrium_is_a_protective_stop(cell):
    cell.call(cell.cell.board.clear)
    cell.physics.broken = True
    cell.call(cell.cell.world.grip, 40.0)
    cell.wait(lambda: cell.cell.cabinet.state == "guardstop")
    cell.physics.broken = False
    assert any("Motion supervision" in entry.title for entry in cell.cell.cabinet.log)
    cell.call(cell.cell.board.clear)
    cell.wait(lambda: cell.cell.cabinet.state == "motoroff")
