"""Reported and true poses: the effect of each calibration error and each mistake of a first day."""

import math

import numpy as np
import pytest

from simulation.scene.unstated import Misplacement, Unstated

APPROACH = (4.0, 0.0, 35.0, 10.0)
ALL_AT_ONCE = {"tcp_offset_mm": (2.0, -1.0), "frame_yaw_deg": 3.0, "blocks_up_mm": 1.5, "x_sign": -1, "yaw_sign": -1}


def true(reported: tuple[float, float, float, float], **unstated: object) -> tuple[float, ...]:
    return Misplacement(Unstated(**unstated), APPROACH).true(reported)


def test_an_offset_of_the_tool_turns_with_the_tool() -> None:
    assert true((4.0, 0.0, 35.0, 0.0), tcp_offset_mm=(2.0, -1.0)) == pytest.approx((6.0, -1.0, 35.0, 0.0))
    assert true((4.0, 0.0, 35.0, 90.0), tcp_offset_mm=(2.0, -1.0)) == pytest.approx((5.0, 2.0, 35.0, 90.0))


def test_a_turned_frame_turns_ways_and_yaw() -> None:
    cos, sin = math.cos(math.radians(3.0)), math.sin(math.radians(3.0))
    assert true((10.0, 0.0, 35.0, 0.0), frame_yaw_deg=3.0) == pytest.approx((10.0 * cos, 10.0 * sin, 35.0, 3.0))


def test_blocks_that_stand_higher_come_sooner() -> None:
    assert true(APPROACH, blocks_up_mm=1.5) == (4.0, 0.0, 33.5, 10.0)


def test_a_wrong_sign_turns_over_what_follows_the_approach() -> None:
    assert true(APPROACH, x_sign=-1, yaw_sign=-1) == APPROACH
    assert true((7.0, 1.0, 30.0, 8.0), x_sign=-1, yaw_sign=-1) == (1.0, 1.0, 30.0, 12.0)


@pytest.mark.parametrize("unstated", [{}, ALL_AT_ONCE, *({key: value} for key, value in ALL_AT_ONCE.items())])
def test_what_the_arm_says_is_where_it_was_sent(unstated: dict[str, object]) -> None:
    misplaced, reported = Misplacement(Unstated(**unstated), APPROACH), (-3.0, 2.0, 28.0, -7.0)
    assert misplaced.reported(misplaced.true(reported)) == pytest.approx(reported, abs=1e-12)
    if not unstated:
        assert misplaced.reported(misplaced.true(reported)) == reported


def test_a_residual_of_a_calibration_is_about_the_middle_and_clockwise_on_screen() -> None:
    wrong = Unstated(camera_scale=(1.0, 1.1), camera_roll_deg=(0.0, 30.0))
    assert wrong.residual_px(0, (160.0, 120.0)) is None
    turn = wrong.residual_px(1, (160.0, 120.0))
    np.testing.assert_allclose(turn @ (160.0, 120.0, 1.0), (160.0, 120.0, 1.0))
    np.testing.assert_allclose(
        turn @ (170.0, 120.0, 1.0), (160.0 + 11.0 * math.cos(math.pi / 6), 125.5, 1.0)
    )  # right goes down
