"""Page of `simulation.studies.hard_probes`, apart from what its results are hashed with."""

from typing import Any

from reporting.page import page
from reporting.table import table
from simulation.studies.hard_probes import CONE_N_PER_MM2, RESIDUAL_N


def hard_probes_page(report: dict[str, Any]) -> str:
    total = report["probes"]
    return page(
        f"""
        # Hard probes

        All {total:,} probes of seed {report["seed"]}, {report["tier"]} tier. In the solved ones, every number is
        finite, the worst force residual is {report["worst_residual_n"]:.1e} N (limit {RESIDUAL_N:.0e}), and the worst
        violation of a friction cone is {report["worst_cone_violation_n_per_mm2"]:.1e} N/mm2 (limit
        {CONE_N_PER_MM2:.0e}). A probe that reported a solution beyond these limits would have ended the run.

        ## How it was measured

        The probes are random descents with contact that is hard to solve: all eight objects, gel friction 0, 0.2, 0.8
        or 2, edge friction 0, 0.25 or 1, blocks of 10 to 10,000 N/mm, fixed or free, grips of 1 to 60 N, load steps of
        0.05, 0.17 or 0.5 mm, and errors over the whole range. Each descends until it just touches, then 0.6 mm and
        1.5 mm deeper, and goes back up.
        """,
        table(report["ended"].items(), ("ended", 0), ("probes", 1, ",d"), ("share", lambda row: row[1] / total, ".2%")),
        f"""
        - "grasp lost": the object left the hand, or weighs more than friction between the pads can carry.
        - "gel squeezed through": the grip force exceeds what the gel can bear.
        - "friction unsettled" (stick and slip each lead to the other), "forces unbalanced" and "pads unsettled" (layer
          tier) are the other refusals.

        Made by `python -m simulation hard-probes --count {total} --out docs`. The command resumes from its JSON file if
        the same physics wrote it, and starts over otherwise. A probe takes about
        {1e-3 * report["cpu_ms_per_probe"]:.2f} s of CPU.
        """,
    )
