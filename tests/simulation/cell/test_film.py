"""The film of an insertion: as many pictures as moments, and the object is where the simulator has it."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from simulation.cell.film import MOST_N, Course, draw
from simulation.cell.run import RunOptions, scene_of
from simulation.cell.world import Exposure
from simulation.data.probe import QuasiStaticCell
from simulation.scene.worlds import load_scene


@pytest.mark.parametrize("sensor", ["gelslim_2019", "gelsight_mini"])
def test_a_descent_becomes_a_film(tmp_path, sensor):
    world = tmp_path / "world.toml"
    world.write_text(f'[camera]\nsensor = "{sensor}"\n')
    scene = scene_of(RunOptions(world=str(world)))
    cell = QuasiStaticCell(scene, seed=0)
    cell.regrasp(8.0, 6.0)
    x, y, z, yaw = (float(value) for value in cell.pose)
    world = SimpleNamespace(held=True, state=None)
    course = Course(world, fps=30.0)
    for tick in range(18):
        world.state = cell.move_to(x, y, z - 0.35 * tick, np.degrees(yaw))
        course(Exposure(tick, tick, world.state.gel, world.state.gel))
    world.held = False
    course(Exposure(18, 18, world.state.gel, world.state.gel))
    course.save(tmp_path / "course.npz", scene.blocks.gap_mm)
    with np.load(tmp_path / "course.npz") as saved:
        assert saved["gel"].shape[0] == 6  # ten a second of thirty
        assert abs(saved["place"][0, 0] - 8.0) < 0.1
        assert saved["place"][-1, 2] < saved["place"][0, 2] - 4.0
    film = draw(tmp_path / "course.npz", tmp_path / "film.gif", scene.sensor)
    with Image.open(film) as opened:
        assert opened.n_frames == 6
        assert opened.size == (900, 300)
    assert film.stat().st_size < MOST_N * 40_000


def test_without_a_course_there_is_no_film(tmp_path):
    assert draw(tmp_path / "none.npz", tmp_path / "film.gif", load_scene("rectangle").sensor) is None
