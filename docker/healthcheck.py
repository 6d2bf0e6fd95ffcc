"""Exit 0 if ``GET PATH`` on this machine's PORT answers 200 within two seconds: the images have no curl.

Sockets only, because importing an HTTP library every ten seconds costs more than the idle service does.
usage: healthcheck.py PORT PATH      ``TACTILE_PORT`` in the environment wins over PORT.
"""

import os
import socket
import sys


def status(port: int, path: str, timeout_s: float = 2.0) -> int:
    """The HTTP status of one request to loopback; 0 if there is no answer."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout_s) as link:
            link.sendall(f"GET {path} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode())
            reply = link.recv(64).split()
    except OSError:
        return 0
    return int(reply[1]) if len(reply) > 1 and reply[1].isdigit() else 0


if __name__ == "__main__":
    sys.exit(status(int(os.environ.get("TACTILE_PORT") or sys.argv[1]), sys.argv[2]) != 200)
