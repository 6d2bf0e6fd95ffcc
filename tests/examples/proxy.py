"""A TCP proxy in front of the service: a link that hangs without being closed, drips, is cut, or is lied on."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable


class Proxy:
    """Forwards bytes both ways until instructed otherwise; one thread per direction of a connection."""

    def __init__(self, port: int) -> None:
        self._service_port = port
        self._open = threading.Event()
        self._open.set()
        self._ended = self._drips = False
        self._sockets: list[socket.socket] = []
        self._clients: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._start(self._accept)

    def hang(self) -> None:
        """Half open: both sides believe in the connection, but nothing comes through any more."""
        self._open.clear()

    def drip(self) -> None:
        """From now on ten bytes per second come through, one by one."""
        self._drips = True

    def cut(self) -> None:
        for sock in self._sockets:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def inject(self, text: str) -> None:
        """Say something to the client in the name of the service."""
        content = text.encode()
        assert len(content) < 126
        self._clients[-1].sendall(bytes((0x81, len(content))) + content)

    def close(self) -> None:
        self._ended = True
        self._open.set()
        self._listening.shutdown(socket.SHUT_RDWR)  # or a waiting accept() goes on
        while self._threads:  # the first one accepts: then no other is started
            self._threads.pop(0).join(10.0)
            self.cut()
        for sock in (self._listening, *self._sockets):
            sock.close()

    def _start(self, work: Callable[..., None], *of: socket.socket) -> None:
        thread = threading.Thread(target=work, args=of, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                service = socket.create_connection(("127.0.0.1", self._service_port))
                self._sockets += (client, service)
                self._clients.append(client)
                for source, sink in ((client, service), (service, client)):
                    self._start(self._pass_on, source, sink)

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while content := source.recv(65536):
                self._open.wait()
                # What was waited for when the dripping began drips, too.
                for part in [content] if not self._drips else [bytes([byte]) for byte in content]:
                    if self._ended:
                        return
                    sink.sendall(part)
                    if self._drips:
                        time.sleep(0.1)
            if self._open.is_set():
                sink.shutdown(socket.SHUT_RDWR)
