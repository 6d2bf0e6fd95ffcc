"""One client moves a cell at a time: while a live command runs, another one of this machine is refused."""

import contextlib
import hashlib
import socket
from collections.abc import Iterator

from robot_client.ports import DriverError
from robot_client.settings import Settings


@contextlib.contextmanager
def alone(settings: Settings) -> Iterator[None]:
    """Keep the cell for this process; raises DriverError if another one has it.

    Between two steps a cycle has no connection of its own that would keep a second client out. A cell is known by its
    gripper's address. The name is the kernel's, not a file's, so it goes with its process, however that ends.
    """
    address = settings.gripper.address
    name = hashlib.sha256(address.encode()).hexdigest()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as kept:
        try:
            kept.bind(f"\0tactile-insertion/{name}")
        except OSError:
            raise DriverError(f"another client has the cell with the gripper {address}: end it first") from None
        yield
