"""The configuration of a commissioned cell: as it was, with its record named and the height of the gap by touch."""

from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from robot_client.session.commission.record import Record, keep_text
from service.contract.toml import toml_text

CELL = "cell.toml"
LEAST_MM = 0.5  # tops that differ by less are as taught: half of what full depth may fall short
LEAST_N = 2  # touches that tell it


def lower_mm(record: Record) -> float | None:
    """How much lower the blocks' tops are than taught, less what is late; None where that is not known.

    An object that hangs so much higher in the hand is the same. Each touch is late at its own speed: an early one is
    met at that of a fast leg.
    """
    late_s, lower = record.late_s, list[float]()
    for one in record.signs:
        if one.below_mm is not None and one.touch_mm_s is not None and late_s is not None:
            lower.append(one.below_mm - one.touch_mm_s * late_s)
    return fmean(lower) if len(lower) >= LEAST_N else None


def teach(tables: Mapping[str, Any], record: Record, path: Path) -> str:
    """Write ``tables``, those of the cell of the record at ``path``, beside it; returns what was taught.

    The approach gets as much lower as the tops are: then an insertion ends as deep below them as was asked for. It
    counts from where it was when the record was begun, so that it is not taught twice.
    """
    z_mm, lower = record.approach_z_mm, lower_mm(record)
    text = "how high the blocks' tops are was not felt: task.approach_z_mm stays"
    if lower is not None and z_mm is not None:
        taught_z_mm = round(z_mm - lower, 1) if abs(lower) >= LEAST_MM else z_mm
        text = f"the blocks' tops are {abs(lower):.1f} mm {'lower' if lower > 0.0 else 'higher'} than taught"
        text += f": task.approach_z_mm {z_mm:g} -> {taught_z_mm:g}" if taught_z_mm != z_mm else ", as good as taught"
        z_mm = taught_z_mm
    task = {**tables.get("task", {}), "object": record.object, "approach_z_mm": z_mm}
    head = f"# The cell as commissioned on {record.begun}, without comments and password; {text}.\n"
    keep_text(path.with_name(CELL), head + toml_text({**tables, "task": task, "commissioning": str(path)}))
    return text
