"""A disk that is full, for tests of what is left on it."""

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """A disk that takes so many bytes of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fill_before(path: Path) -> None:
    """Let the disk be full the next time that this process writes the file."""
    path.with_name(f".{path.name}.{os.getpid()}.tmp").symlink_to("/dev/full")
