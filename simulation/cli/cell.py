"""`python -m simulation cell`: one cell in real time, until it is interrupted."""

import asyncio

import tyro

from simulation.cell.live import bind_all, serve
from simulation.cell.options import CellOptions
from simulation.cell.plant import build, load


def main(arguments: list[str]) -> int:
    """Start robot, gripper and cameras on loopback; exit 0 on SIGINT or SIGTERM, 1 if the physics failed."""
    options = tyro.cli(CellOptions, args=arguments, prog="tactile-insertion cell", description=__doc__)
    options.check()
    scene = load(options)
    options.out.mkdir(parents=True, exist_ok=True)  # refused before there are sockets and threads
    sockets = bind_all(options)
    return asyncio.run(serve(options, build(scene, options), sockets))
