"""The cameras over HTTP."""

import itertools
import re
import socket
import time
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np
import pytest

from tests.simulation.physics.bench import bench, forever


class Stream:
    """A multipart reader."""

    def __init__(self, url):
        parts = urlsplit(url)
        self.sock = socket.create_connection((parts.hostname, parts.port), timeout=30.0)
        self.sock.sendall(f"GET {parts.path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        self.buffer = b""
        self.head = self._until(b"\r\n\r\n")

    def _until(self, mark):
        while mark not in self.buffer:
            data = self.sock.recv(65536)
            if not data:
                raise ConnectionError
            self.buffer += data
        part, self.buffer = self.buffer.split(mark, 1)
        return part

    def part(self):
        """(captured_ns, seq, jpeg)."""
        head = self._until(b"\r\n\r\n").decode()
        length = int(re.search(r"Content-Length: (\d+)", head)[1])
        while len(self.buffer) < length:
            self.buffer += self.sock.recv(65536)
        jpeg, self.buffer = self.buffer[:length], self.buffer[length:]
        stamp = re.search(r"X-Timestamp: (\d+)\.(\d{9})", head)
        return int(stamp[1] + stamp[2]), int(re.search(r"X-Sequence: (\d+)", head)[1]), jpeg

    def newest(self):
        """The first part captured from now on."""
        now = time.monotonic_ns()
        while True:
            part = self.part()
            if part[0] >= now:
                return part

    def close(self):
        self.sock.close()


@pytest.fixture(scope="module")
def cell():
    with bench() as made:
        yield made


@pytest.fixture
def left(cell):
    cell.call(cell.cell.board.clear)
    stream = Stream(cell.description["cameras"]["left"])
    yield stream
    stream.close()


def image(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def test_frames_come_at_30_hz_with_steady_stamps_and_right_size(left):
    assert b"multipart/x-mixed-replace" in left.head
    left.newest()
    parts = [left.part() for _ in range(16)]
    stamps, seqs = [p[0] for p in parts], [p[1] for p in parts]
    assert all(b > a for a, b in itertools.pairwise(seqs))
    assert (stamps[-1] - stamps[0]) / 1e9 / (seqs[-1] - seqs[0]) == pytest.approx(1 / 30, rel=0.1)
    assert image(parts[0][2]).shape == (320, 427, 3)
    assert abs(time.monotonic_ns() - stamps[-1]) < 2e10


def test_both_fingers_share_the_capture_stamp(cell, left):
    right = Stream(cell.description["cameras"]["right"])
    a = {p[1]: p[0] for p in (left.part() for _ in range(10))}
    b = {p[1]: p[0] for p in (right.part() for _ in range(10))}
    right.close()
    shared = a.keys() & b.keys()
    assert shared
    assert all(a[seq] == b[seq] for seq in shared)


def test_stall_duplicate_size_black_and_garbage_can_be_had(cell, left):
    cell.faults(camera_left={"half_size": True})
    time.sleep(0.1)
    assert image(left.newest()[2]).shape == (160, 214, 3)
    cell.faults(camera_left={"half_size": False, "black": True})
    time.sleep(0.1)
    assert image(left.newest()[2]).max() <= 2
    cell.faults(camera_left={"black": False, "garbage_next": 1})
    assert any(not p[2].startswith(b"\xff\xd8") for p in (left.part() for _ in range(6)))
    cell.faults(camera_left={"duplicate": True})
    time.sleep(0.1)
    [left.part() for _ in range(4)]
    assert left.part()[:2] == left.part()[:2]
    cell.faults(camera_left={"duplicate": False, "stall": True})
    left.sock.settimeout(0.4)
    with pytest.raises(TimeoutError):
        forever(left.part)


def test_a_disconnected_camera_closes_and_comes_back(cell, left):
    cell.faults(camera_left={"disconnect": True})
    with pytest.raises(ConnectionError):
        forever(left.part)
    assert httpx.get(cell.description["cameras"]["left"]).status_code == 503
    cell.faults(camera_left={"disconnect": False})
    again = Stream(cell.description["cameras"]["left"])
    assert again.newest()[2].startswith(b"\xff\xd8")
    again.close()


def test_a_client_that_does_not_read_delays_nobody(cell, left):
    idle = Stream(cell.description["cameras"]["left"])
    left.newest()
    first = left.part()
    for _ in range(30):
        last = left.part()
    assert (last[0] - first[0]) / 1e9 < 60.0
    idle.close()


def test_only_the_stream_is_served(cell):
    base = cell.description["cameras"]["left"].rsplit("/", 1)[0]
    assert httpx.get(base + "/other").status_code == 404
