"""Waiting for what another thread or process does, for as long as a busy machine may need."""

import time
from collections.abc import Callable
from typing import TypeVar

Answer = TypeVar("Answer")


def wait_for(holds: Callable[[], Answer], within_s: float = 60.0) -> Answer:
    """What ``holds`` gives as soon as that is true."""
    until_s = time.monotonic() + within_s
    while not (answer := holds()):
        assert time.monotonic() < until_s, f"not within {within_s:g} s"
        time.sleep(0.01)
    return answer
