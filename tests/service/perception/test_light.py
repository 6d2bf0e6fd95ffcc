"""The light on a gel is the same however it is exposed and wherever its markers are, and another gel's is another."""

import base64

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from service.perception.light import OTHER_LIGHT, check_light, light_apart, light_of

PARTS = arrays(np.uint8, (8, 8, 3), elements=st.integers(5, 60))
WIDTH_PX, HEIGHT_PX = 327, 320
WHITE = light_of(np.full((8, 8, 3), 255, np.uint8))


def picture(parts: np.ndarray) -> np.ndarray:
    """A picture whose parts have these levels; its sides are no multiples of eight."""
    parts_px = np.repeat(np.repeat(parts, HEIGHT_PX // 8, 0), WIDTH_PX // 8, 1)
    return np.pad(parts_px, ((0, HEIGHT_PX % 8), (0, WIDTH_PX % 8), (0, 0)), constant_values=255)


def apart(one: np.ndarray, other: np.ndarray) -> float:
    away = light_apart(light_of(one), light_of(other))
    assert away is not None
    return away


@given(PARTS)
def test_a_light_is_the_level_of_each_part(parts: np.ndarray):
    assert base64.b64decode(light_of(picture(parts))) == parts.tobytes()


@given(PARTS, st.tuples(*[st.integers(1, 4)] * 3))
def test_neither_exposure_nor_white_balance_changes_a_light(parts: np.ndarray, gains: tuple[int, int, int]):
    assert apart(picture(parts), picture(parts * np.array(gains, np.uint8))) < 1e-9


@given(PARTS, PARTS)
def test_two_lights_are_as_far_apart_whichever_comes_first(one: np.ndarray, other: np.ndarray):
    there, back = apart(picture(one), picture(other)), apart(picture(other), picture(one))
    assert there == pytest.approx(back)
    assert there >= 0


@given(PARTS, st.integers(0, 2**32 - 1))
def test_markers_and_dust_on_less_than_half_of_each_part_do_not_matter(parts: np.ndarray, seed: int):
    dotted, rng = picture(parts), np.random.default_rng(seed)
    dotted[rng.integers(0, 15) :: 15, :] = rng.integers(0, 255)
    dotted[:, rng.integers(0, 15) :: 5] = 0
    assert apart(picture(parts), dotted) == 0


@given(PARTS, st.sampled_from([0, 1, 2]), st.floats(0.25, 0.5))
def test_a_side_that_is_darker_in_one_colour_is_another_light(parts: np.ndarray, colour: int, share: float):
    even = picture(np.full_like(parts, 100))
    darker = even.copy()
    darker[:, : WIDTH_PX // 2, colour] = 100 * share
    assert apart(even, darker) > 2 * OTHER_LIGHT


def test_a_tenth_more_light_on_one_half_in_one_colour_is_a_sixtieth():
    """Half of one colour of three is 5 % up, the other half 5 % down, both less for the share that is added."""
    even = np.full((64, 64, 3), 100, np.uint8)
    brighter = even.copy()
    brighter[:, :32, 1] = 110
    assert apart(even, brighter) == pytest.approx(0.1 / 2 / 3 / 1.2, rel=0.1)


def test_a_black_picture_has_a_light():
    assert apart(np.zeros((64, 64, 3), np.uint8), np.zeros((64, 64, 3), np.uint8)) == 0


@pytest.mark.parametrize("pair", [("", WHITE), ("", "")])
def test_a_light_that_is_not_known_is_not_compared(pair: tuple[str, str]):
    assert light_apart(*pair) is None
    assert light_apart(*pair[::-1]) is None


@pytest.mark.parametrize("text", ["AQE=", "light", WHITE[:-1], f"{WHITE[:8]}\n{WHITE[8:]}"])
def test_a_text_that_is_no_light_is_refused(text: str):
    check_light("")
    with pytest.raises(ValueError, match="no light of a gel"):
        check_light(text)
