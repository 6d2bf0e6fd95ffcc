"""Names of recordings: a UTC stamp and the insertion's id. Sorted, they are in the order in which they were made."""

import contextlib
import re
from datetime import datetime, timedelta
from pathlib import Path

NAME = re.compile(r"([0-9]{8}T[0-9]{6,12})_[A-Za-z0-9_-]{1,64}")
_STAMP = "%Y%m%dT%H%M%S%f"


def name_after(root: Path, insertion_id: str, started: datetime) -> str:
    """The name of a new recording in ``root``: sorted behind all others, even where the clock was set back."""
    folders = root.iterdir() if root.is_dir() else ()
    newest = max((known[1] for folder in folders if (known := NAME.fullmatch(folder.name))), default="")
    stamp = started.strftime(_STAMP)
    if stamp <= newest:
        with contextlib.suppress(ValueError, OverflowError):  # digits that are no time
            after = datetime.strptime(newest.ljust(len(stamp), "0"), _STAMP) + timedelta(microseconds=1)  # noqa: DTZ007
            stamp = after.strftime(_STAMP)
    return f"{stamp}_{insertion_id}"
