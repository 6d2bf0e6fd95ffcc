"""The page of how far the arm moves after nobody looks any more."""

from typing import Any

from reporting.page import page
from reporting.table import table
from simulation.studies.motion_bounds.play import BOUND_MM, MOST_N

NAME = "motion_bounds"
Rows = list[dict[str, Any]]


def bounds_page(data: dict[str, Any]) -> str:
    rows: Rows = data["rows"]
    bounded = [row for row in rows if row["bounded"]]
    met = sum(row["injected"] for row in rows)
    worst = max(bounded, key=lambda row: row["travel_mm"])
    return page(
        "# How far the arm moves after nobody looks any more",
        """
        While it descends, the arm goes on only for frames that were judged
        ([the motion lease](decisions/0051-motion-lease.md)). Here live insertions are broken on purpose: simulated
        cell, service and client are processes of their own and speak over sockets, a relay between service and client
        makes the bad network, and the arm descends as shipped: at 10 mm/s, at 5 mm/s around the blocks' tops, with a
        lag of 20 ms. Everything is simulated. `make trust-live` writes this page.
        """,
        f"""
        {len(rows)} broken insertions, {met} of them in the phase that was asked for. Of the {len(bounded)} that the
        lease bounds, the worst is *{worst["fault"]}, {worst["phase"]}*: {worst["travel_mm"]:.2f} mm after the capture
        of the last judged frame, where {BOUND_MM:g} mm are allowed. The largest force was
        {max(row["force_n"] for row in bounded):.1f} N ({MOST_N:g} N allowed). After a hold nothing moved by more than
        {max(row["moved_mm"] for row in rows):.2f} mm, {sum(row["hung"] for row in rows)} processes hung, and
        {sum(row["tracebacks"] > 0 for row in rows)} wrote a traceback.
        """,
        """
        *Travel* is the largest way down, stop lag included, after the capture of the last picture that showed the world
        and was judged. *Force* is the largest on the object in the whole insertion, corrections and later attempts
        included. An insertion that ends `inserted` outlived its fault.
        """,
        "## What the lease bounds",
        _table(bounded),
        "## What it cannot bound",
        """
        A picture that is older than its stamp cannot be distinguished from a new one by its content. A camera server
        should stamp its frames when they are captured; one that does not is only as good as its latency, and nothing
        measures that yet: here the delay begins in mid-descent, and the gap that it tears ends the lease, but one that
        was there from the start adds 1 mm for each 100 ms at every stop.

        A picture that stands still beneath fresh noise is recognised by its own noise, which comes along each time
        ([decision 132](decisions/0132-noise-comes-once.md)). The first copy passes for new, which is one frame period
        more than the bound, and the service must have seen the picture when it was new. It looks at none between
        closing the fingers and arming, nor between two attempts: a camera that begins to repeat itself there, on both
        fingers at once, is bounded by nothing but full depth, or by the forces that the grasp bears.
        """,
        _table([row for row in rows if not row["bounded"]]),
    )


def _table(rows: Rows) -> Any:
    return table(
        rows,
        ("fault", "fault"),
        ("phase", "phase"),
        ("travel mm", "travel_mm", ".2f"),
        ("force N", "force_n", ".1f"),
        ("the client ended with", lambda row: row["ended"] if row["injected"] else "ended before the phase came"),
    )
