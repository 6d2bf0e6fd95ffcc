"""A descent's onset is motion of the object, and a press outlives the lift after it."""

import math
from pathlib import Path

import pytest

from simulation.data.collect import Plan, pokes
from simulation.data.probe import ONSET_MM, Probe, descend
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.state import CellState, PhysicsError
from simulation.scene.worlds import load_scene


def creeping(x_mm: float) -> QuasiStaticCell:
    """A heavy object above the gap at this error, in a gel that relaxes: its weight makes the markers creep."""
    cell = QuasiStaticCell(load_scene("circle", gel__relaxation_share=0.4, object__mass_kg=0.5), 0)
    cell.regrasp(x_mm, 0.0)
    return cell


def pressed(x_mm: float) -> Probe:
    cell = creeping(x_mm)
    yaw_deg, rate = math.degrees(float(cell.pose[3])), cell.scene.speed_mm_s / 0.15
    return descend(cell, float(cell.pose[0]), yaw_deg, phase=0.5, fps=rate, press_mm=1.65)


def test_markers_that_creep_under_the_objects_weight_are_no_collision() -> None:
    hanging = creeping(0.0)
    crept = hanging.look().gel - hanging.wait(2.0).gel
    assert abs(crept[..., :2]).max() > ONSET_MM, "what a collision would show, without one"
    free = pressed(0.0)
    assert (free.outcome, free.onset_frame) == ("inserted", -1)


def test_a_press_begins_where_the_object_touches() -> None:
    press = pressed(8.0)
    assert press.outcome == "blocked"
    pushed_n = press.wrench[:, 2] - press.wrench[0, 2]
    assert abs(pushed_n[: press.onset_frame - 1]).max() < 1e-6
    assert pushed_n[press.onset_frame] > 0.1
    assert press.depth_mm[-1] - press.depth_mm[press.onset_frame] == pytest.approx(1.65)


def test_a_press_is_kept_where_the_lift_after_it_finds_no_equilibrium(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = pokes(Plan(tmp_path, "circle", 0, 4, 0, 0.3), load_scene("circle"))
    fixture, poke, _, probe = next(made)
    assert poke == 0
    assert probe is not None
    assert probe.outcome == "blocked"
    look, failed = QuasiStaticCell.look, []

    def unsolved_once(cell: QuasiStaticCell) -> CellState:
        if failed:
            return look(cell)
        failed.append(cell)
        raise PhysicsError("no iteration balances the forces", "forces unbalanced")

    monkeypatch.setattr(QuasiStaticCell, "look", unsolved_once)
    next_fixture, poke, _, probe = next(made)
    assert failed
    assert probe is not None, "the lift is no press"
    assert (poke, next_fixture.group) != (1, fixture.group), "and the hand is not used again"
