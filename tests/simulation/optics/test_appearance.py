"""Appearances: drawn from the scene and a seed, kept exactly."""

import json

import pytest

from service.contract import Sensor
from simulation.optics.renderer import Appearance
from simulation.scene.worlds import load_scene


def test_an_appearance_survives_json_and_depends_on_finger_and_seed() -> None:
    scene = load_scene("rectangle")
    look = Appearance.draw(scene, "right", 11)
    assert Appearance.from_dict(json.loads(json.dumps(look.as_dict())), scene.sensor) == look
    assert Appearance.draw(scene, "right", 11) == look
    assert Appearance.draw(scene, "left", 11) != look
    assert Appearance.draw(scene, "right", 12) != look


def test_unknown_keys_are_refused() -> None:
    with pytest.raises(ValueError, match=r"unknown keys .*sparkle"):
        Appearance.from_dict({**Appearance().as_dict(), "sparkle": 1}, Sensor.load())


@pytest.mark.parametrize(
    "name", ["rectangle", "circle", "ellipse", "hexagon", "white_box", "vitamin", "can", "mustard"]
)
def test_every_built_in_scene_has_a_look(name: str) -> None:
    scene = load_scene(name)
    assert Appearance.draw(scene, "left", 0).noise_sigma_grey == scene.camera.noise_grey
