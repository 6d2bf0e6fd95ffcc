"""`explain` measures what an effect costs where it has work to do."""

import numpy as np

from reporting.machine import best_cpu_ms
from simulation.cli import explain
from simulation.cli.explain import cost, frame_ms, poke_ms
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene


def test_a_frame_is_timed_with_the_gel_in_motion() -> None:
    scene = load_scene("circle")
    renderer, still = Renderer(Appearance.draw(scene, "left", 0)), np.full((20, 21, 3), 0.04, np.float32)
    assert frame_ms(scene) > 2.0 * best_cpu_ms(lambda: renderer.raw(still, 1), 10)


def test_the_effects_of_an_object_in_a_world_are_explained(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(explain, "cost", lambda *_: "")
    (tmp_path / "creeping.toml").write_text("[gel]\nrelaxation_share = 0.3\n")
    explain.explain(["rectangle"])
    assert "off relaxation" in capsys.readouterr().out
    explain.explain(["rectangle", "--world", str(tmp_path / "creeping.toml")])
    shown = capsys.readouterr().out
    assert "on  relaxation        gel.relaxation_share is 0.3" in shown
    assert "on  free_blocks" in shown, "as an insertion meets them"


def test_effects_are_explained_at_the_speed_at_which_an_arm_descends(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(explain, "cost", lambda *_: "")
    shown = set()
    for speed_mm_s in (10, 200):
        (tmp_path / "quick.toml").write_text(f"[motion]\ndescent_speed_mm_s = {speed_mm_s}\n")
        explain.explain(["rectangle", "--world", str(tmp_path / "quick.toml")])
        shown.add(capsys.readouterr().out)
    assert len(shown) == 1


def test_the_physics_of_a_lost_object_is_no_cost() -> None:
    """Nothing is solved once it has dropped; such a poke would count as the quickest."""
    dropped = load_scene("circle").varied({"gel.friction": 0.01, "effects.gravity": "on", "object.mass_kg": 2.0})
    assert poke_ms(dropped) == float("inf")
    assert cost(dropped, "gravity") == "the grasp does not hold: no cost measured"
