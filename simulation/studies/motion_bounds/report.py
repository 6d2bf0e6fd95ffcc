"""The page on how far the arm moves once no frame is judged any more."""

from collections.abc import Iterator
from typing import Any

from reporting.page import page
from reporting.table import table
from robot_client.insertion.lease import SLOW_MM
from simulation.studies.motion_bounds.play import MOST_N

NAME = "motion_bounds"
Rows = list[dict[str, Any]]


def bounds_page(data: dict[str, Any]) -> str:
    rows: Rows = data["rows"]
    met = sum(row["injected"] for row in rows)
    worst = max(rows, key=lambda row: row["travel_mm"])
    return page(
        f"""
        # How far the arm moves once nobody watches, simulated

        The worst of {len(rows)} faults is *{worst["fault"]}, {worst["phase"]}*: the arm travelled
        {worst["travel_mm"]:.2f} mm after the capture of the last judged frame. The limit is {SLOW_MM:g} mm. Some
        faults of cameras, worse than those tried here, [are not bounded](#what-it-cannot-bound).

        The largest force was {max(row["force_n"] for row in rows):.1f} N; the limit is {MOST_N:g} N. After a hold,
        nothing moved by more than {max(row["moved_mm"] for row in rows):.2f} mm.
        {sum(row["hung"] for row in rows)} processes hung, and {sum(row["tracebacks"] > 0 for row in rows)} wrote a
        traceback. All figures are simulated.

        ## How it was measured

        A descent only continues while frames are judged ([the motion lease](decisions/0051-motion-lease.md)). The test
        injects a fault into each of {len(rows)} live insertions; {met} took effect in the intended phase. The simulated
        cell, the service and the client are separate processes, and a relay degrades the network between the last two.
        A wall clock is set in one process alone, by a library that is compiled for it and loaded before it. The arm
        descends as shipped, at 10 mm/s and at 5 mm/s around the tops of the blocks, with a lag of 20 ms.

        - **Travel**: the largest distance downwards, standstill included, after the capture of the last frame that
          showed the world and was judged.
        - **Force**: the largest on the object during the whole insertion, later attempts included.

        ## Every fault
        """,
        _table(rows),
        *_quicker(data.get("quicker", [])),
        _BEYOND,
        "`make trust-live` repeats the test and writes this page.",
    )


def _quicker(rows: Rows) -> Iterator[Any]:
    """Rows of a descent at 25 mm/s, with cameras at 60 frames a second and the lease that such a speed may have."""
    if rows:
        most, force_n = (max(row[key] for row in rows) for key in ("travel_mm", "force_n"))
        held_n, bound_mm = sum(row["held"] for row in rows), rows[0]["bound_mm"]
        yield f"""
        ## At 25 mm/s

        A client may be told to descend at 25 mm/s, all the way; with the sensor's 30 frames a second it refuses. With
        60 it was given a lease of {bound_mm:g} mm, 12 mm of air, and {len(rows)} of the faults above: cameras that
        stall, freeze, go black or are 300 ms late, a late link, and a service or client that stops for 1 s. {held_n}
        hold, with {most:.2f} mm and {force_n:.1f} N at most. `make trust-live` leaves these rows as they are; they come
        from `motion-bounds --fps 60 --client FILE --only FAULT --runs FOLDER` with these tables:
        """
        yield _QUICK
        yield _table(rows)


def _table(rows: Rows) -> Any:
    return table(
        rows,
        ("fault", "fault"),
        ("phase", "phase"),
        ("travel mm", "travel_mm", ".2f"),
        ("force N", "force_n", ".1f"),
        ("how the client ended", lambda row: row["ended"] if row["injected"] else "ended before that phase"),
    )


_QUICK = """
```toml
ramps.descend = { speed_mm_s = 25.0, acceleration_mm_s2 = 400.0, jerk_mm_s3 = 8000.0 }
lease = { travel_mm = 2.5 }
limits = { max_descent_speed_mm_s = 25.0 }
pace = { fast_mm_s = 25.0, fast_travel_mm = 2.5 }
task = { approach_clearance_mm = 12.0 }
```
"""

_BEYOND = """
## What it cannot bound

**Pictures without stamps that were late from the start.** Each 100 ms of it adds 1 mm to every stop. A delay that
begins later shows as a silence, after which [such a camera counts as lost](decisions/0035-frames-and-their-age.md).
Let the camera server stamp its frames at capture (`X-Timestamp` in the header of each part, in seconds of the cell
PC's monotonic clock). One that does not is only as good as its latency, which commissioning measures.

**A frozen picture with fresh noise** [does not renew the lease](decisions/0199-a-first-copy-renews-no-lease.md) if
its original was judged. That was tried beneath noise of up to two grey levels, less than the simulated camera's own.
Beneath much stronger noise, and in video that was compressed across its frames, only the second copy is recognised:
the bound grows by one frame period. No frames are judged between closing the fingers and arming, nor between two
attempts. If both cameras begin to repeat themselves there, only full depth and the forces that the grasp can carry
bound the motion.
"""
