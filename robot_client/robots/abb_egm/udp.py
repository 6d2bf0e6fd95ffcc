"""The socket that the robot sends to, and the address that it sends from."""

import socket

from robot_client.ports import DriverError
from robot_client.robots.abb_egm.settings import Settings


def listen(settings: Settings) -> socket.socket:
    """A socket at the configured address; raises DriverError."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.setblocking(False)
    try:
        listener.bind((settings.bind, settings.port))
    except OSError as error:
        listener.close()
        raise DriverError(f"robot: cannot listen on UDP {settings.bind}:{settings.port}: {error}") from None
    return listener


def address_of(host: str) -> str:
    """The address of a host, as in datagrams; its name, which is in none, if that has no address now."""
    try:
        return socket.gethostbyname(host)
    except OSError:
        return host
