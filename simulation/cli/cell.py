"""Commands that run the cell in real time: normally, or with deliberate faults."""

import asyncio
import json
import sys

import tyro

from reporting.page import publish
from simulation.cell.live import bind_all, serve
from simulation.cell.options import CellOptions, warn_of_keys_without_effect
from simulation.cell.plant import build, load
from simulation.cli.run import exit_status
from simulation.studies.motion_bounds import report as bounds_report
from simulation.studies.motion_bounds.campaign import BoundsOptions, measure


def cell(arguments: list[str]) -> int:
    """Run the cell in real time: robot, gripper, cameras on loopback. Exit 0 on interrupt, 1 if the physics failed."""
    options = tyro.cli(CellOptions, args=arguments, prog="tactile-insertion cell", description=cell.__doc__)
    options.check()
    scene = load(options)
    warn_of_keys_without_effect(options.world, options.object)
    options.out.mkdir(parents=True, exist_ok=True)  # fails before sockets and threads exist
    sockets = bind_all(options)
    return asyncio.run(serve(options, build(scene, options), sockets))


def motion_bounds(arguments: list[str]) -> int:
    """Inject every fault in every phase; exit 0 if all bounds hold, 1 if one does not."""
    options = tyro.cli(BoundsOptions, args=arguments, prog="tactile-insertion motion-bounds")
    if not options.out.is_dir():
        raise ValueError(f"--out {options.out}: expected an existing folder")

    def break_all() -> int:
        rows = measure(options, lambda line: print(line, flush=True))
        broken = [row for row in rows if not row["held"]]
        if not (options.only or options.client or options.fps):
            path = options.out / f"{bounds_report.NAME}.json"
            known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
            data = known | {"rows": rows}  # what was measured at another speed stays
            print(publish(options.out, bounds_report.NAME, bounds_report.bounds_page(data), data))
        for row in broken:
            print(f"motion-bounds: does not hold: {row}", file=sys.stderr)
        return 1 if broken else 0

    return exit_status("motion-bounds", break_all)
