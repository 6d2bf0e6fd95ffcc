"""The simulated plant behind the live cell: physics of one scene, optics of both fingers, their calibration."""

import math

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS
from service.perception.rectification import Calibration
from simulation.cell.cameras import Draw
from simulation.cell.emulators.abb.motion import Pose, tool_down
from simulation.cell.live import Plant
from simulation.cell.options import CellOptions, draw_start
from simulation.cell.world import Gel
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.effects import dropped_share
from simulation.scene.scene import Scene
from simulation.scene.worlds import freed, load_scene, load_world

Image = NDArray[np.uint8]
LIVE_RESIDUAL_N = 1e-4  # far below what a camera can show; solving to 1e-7 N may miss a camera tick


def load(options: CellOptions) -> Scene:
    """The scene of the options, the blocks free unless object or world fix them; raises SceneError."""
    changes: dict[str, object] = {"numerics.residual_n": LIVE_RESIDUAL_N}
    changes |= {"camera.fps": options.fps} if options.fps else {}
    scene = freed(load_scene(options.object))
    if options.world is not None:
        scene = load_world(options.world).around(scene)
    return scene.varied(changes)


def _drawer(renderer: Renderer, seed: int) -> Draw:
    def draw(gel: Gel, frame_seed: int, previous: Gel) -> Image:
        return renderer.raw(gel, (seed << 32) + frame_seed, previous)

    return draw


def build(scene: Scene, options: CellOptions) -> Plant:
    """Physics and optics of ``scene``, compiled and warm, the object in the hand with the requested error."""
    _compile(scene, options)
    cell = QuasiStaticCell(scene, seed=options.seed)
    cell.regrasp(options.x_mm, options.theta_deg)
    renderers = {finger: Renderer(Appearance.draw(scene, finger, options.seed)) for finger in FINGERS}
    calibration = Calibration(*(renderers[finger].calibration for finger in FINGERS))

    fed: set[int] = set()  # parts that have arrived; one that was put back comes again, to the same box

    def regrasp(_force_n: float, part_n: int) -> Pose:
        x_mm, theta_deg = options.x_mm, options.theta_deg
        if options.feed and part_n not in fed:
            fed.add(part_n)
            cell.reset_blocks()
        if options.feed:
            x_mm, theta_deg = draw_start(scene, options.seed + part_n)
        cell.regrasp(x_mm, theta_deg)
        return _pose_of(cell)

    return Plant(
        mechanics=cell,
        regrasp=regrasp,
        draw={finger: _drawer(renderers[finger], options.seed) for finger in FINGERS},
        start=_pose_of(cell),
        part_width_mm=scene.object.held_width_mm,
        gap_width_mm=scene.blocks.gap_mm,
        neighbours_stay=scene.neighbours_stay,
        full_depth_mm=scene.full_depth_mm,
        save_calibration=calibration.save,
        sensor=scene.sensor,
        fps=scene.fps,
        dropped_share=dropped_share(scene),
    )


def _pose_of(cell: QuasiStaticCell) -> Pose:
    x, y, z, yaw = (float(value) for value in cell.pose)
    return Pose((x, y, z), tool_down(math.degrees(yaw)))


def _compile(scene: Scene, options: CellOptions) -> None:
    """Touch a block once on a throwaway cell, so that the compiled code is loaded before the clock starts."""
    cell = QuasiStaticCell(scene, seed=options.seed)
    cell.regrasp(8.0, 6.0)
    x, y, z, yaw = (float(value) for value in cell.pose)
    for depth_mm in (5.2, 5.6):
        cell.move_to(x, y, z - depth_mm, math.degrees(yaw))
