"""Exit 0 if ``GET PATH`` on this machine's PORT answers 200 within two seconds: the images have no curl.

Sockets only, because importing an HTTP library every ten seconds costs more than the idle service does.
usage: healthcheck.py PORT PATH      ``TACTILE_PORT`` in the environment wins over PORT. The service's own settings
``TACTILE_HOST`` (if it listens at one address only) and ``TACTILE_TLS_CERTIFICATE`` are followed.
"""

import os
import socket
import sys

ANYWHERE = {"", "0.0.0.0", "::"}  # noqa: S104 - addresses that include loopback


def status(port: int, path: str, timeout_s: float = 2.0) -> int:
    """The HTTP status of one request; 0 if there is no answer."""
    host = os.environ.get("TACTILE_HOST", "")
    try:
        with socket.create_connection(("127.0.0.1" if host in ANYWHERE else host, port), timeout_s) as plain:
            link = encrypted(plain) if os.environ.get("TACTILE_TLS_CERTIFICATE") else plain
            link.sendall(f"GET {path} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode())
            reply = link.recv(64).split()
    except OSError:
        return 0
    return int(reply[1]) if len(reply) > 1 and reply[1].isdigit() else 0


def encrypted(plain: socket.socket) -> socket.socket:
    """The connection under TLS. The certificate names the service to others, not to its own machine."""
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context.wrap_socket(plain)


if __name__ == "__main__":
    sys.exit(status(int(os.environ.get("TACTILE_PORT") or sys.argv[1]), sys.argv[2]) != 200)
