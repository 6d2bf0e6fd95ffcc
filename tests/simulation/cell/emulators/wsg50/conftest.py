"""A gripper with open fingers, and one client of it."""

import pytest

from robot_client.grippers.wsg50.codes import Command, GraspingState, SystemState
from tests.simulation.physics.bench import WsgClient, bench


@pytest.fixture(scope="package")
def cell():
    with bench() as made:
        yield made


@pytest.fixture
def gripper(cell):
    cell.call(cell.cell.board.clear)
    cell.physics.lost = False
    cell.call(setattr, cell.cell.part, "_there", True)
    client = WsgClient(cell.description["gripper"])
    client.ask(Command.ACKNOWLEDGE, b"ack")
    client.do(Command.RELEASE, 100.0, 400.0)
    yield client
    client.close()
    cell.wait(lambda: cell.cell.wsg.connection is None)


def state(client):
    return GraspingState(client.ask(Command.GRASPING_STATE, 0, 0).values[0])


def bits(client):
    return SystemState(client.ask(Command.SYSTEM_STATE, 0, 0).values[0])
