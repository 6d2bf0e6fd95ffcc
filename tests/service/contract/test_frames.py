import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import FINGERS, ContractError, FrameSpec, TactileFrame, decode_frame, encode_frame


@st.composite
def frames(draw):
    height, width = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    pixels = np.random.default_rng(draw(st.integers(0, 2**32))).integers(0, 256, (height, width, 3), np.uint8)
    return TactileFrame(
        draw(st.sampled_from(FINGERS)), draw(st.integers(0, 2**64 - 1)), draw(st.integers(0, 2**64 - 1)), pixels
    )


@given(frames())
def test_a_frame_survives_the_wire(frame):
    back = decode_frame(encode_frame(frame))
    assert (back.finger, back.seq, back.captured_ns) == (frame.finger, frame.seq, frame.captured_ns)
    assert np.array_equal(back.pixels, frame.pixels)


@given(frames(), st.data())
def test_a_frame_of_another_length_is_refused(frame, data):
    message = encode_frame(frame)
    cut = data.draw(st.integers(0, len(message) - 1))
    for wrong in (message[:cut], message + b"\0"):
        with pytest.raises(ContractError, match="expected"):
            decode_frame(wrong)


@pytest.mark.parametrize(("dtype", "shape"), [(np.float32, (3, 4, 3)), (np.uint8, (4, 3, 3)), (np.uint8, (3, 4))])
def test_a_frame_of_another_shape_or_type_is_named(dtype, shape):
    with pytest.raises(ContractError, match=r"expected uint8\[3, 4, 3\]"):
        FrameSpec(height_px=3, width_px=4).check(np.zeros(shape, dtype))
