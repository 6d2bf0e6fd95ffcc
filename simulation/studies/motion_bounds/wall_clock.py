"""Set the wall clock of one process while it runs; those of the machine and all steady clocks stay as they are."""

import os
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

SOURCE = Path(__file__).with_suffix(".c")
FOLDER = "WALL_CLOCKS"  # in the environment: a file for each process, named by its id


@contextmanager
def settable() -> Iterator[None]:
    """The wall clock of each process that is started here can be set; needs the C compiler ``cc``."""
    with TemporaryDirectory() as folder:
        library = f"{folder}/wall_clock.so"
        subprocess.run(("cc", "-O2", "-shared", "-fPIC", "-o", library, SOURCE), check=True)
        with patch.dict(os.environ, {"LD_PRELOAD": library, FOLDER: folder}):
            yield


def set_ahead(process_id: int, seconds: int) -> None:
    """Set a process' wall clock, and those of its children, so far ahead of the machine's."""
    with (Path(os.environ[FOLDER]) / str(process_id)).open("r+b") as file:
        file.write(struct.pack("q", seconds))
