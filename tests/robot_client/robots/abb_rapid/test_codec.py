"""The text of our RAPID modules, in both directions: read or refused, however the stream is cut."""

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.geometry import Pose as WirePose
from robot_client.robots.abb_rapid import codec
from robot_client.robots.abb_rapid.codec import RapidTextError, TextParser


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0, 0.0])
def test_bad_numbers_never_become_text(bad):
    with pytest.raises(RapidTextError):
        codec.encode_move(1, WirePose(0, 0, 0), bad)
    if not math.isfinite(bad):
        with pytest.raises(ValueError, match="finite"):
            codec.encode_move(1, WirePose(bad, 0, 0), 10.0)


@given(st.lists(st.binary(max_size=120), max_size=10))
def test_random_bytes_are_refused_without_harm(chunks):
    parser = TextParser()
    for chunk in chunks:
        for text in parser.feed(chunk):
            for decode in (codec.decode_guard, codec.decode_motion):
                with contextlib.suppress(ValueError):
                    decode(text)
    assert len(parser._rest) <= 80


@given(st.lists(st.text(st.sampled_from("DSE 0123"), max_size=80), max_size=6), st.data())
def test_cuts_of_the_stream_change_nothing(texts, data):
    wire = "".join(f"{text}#" for text in texts).encode()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)), max_size=6)))
    parser = TextParser()
    read = [text for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True) for text in parser.feed(wire[a:b])]
    assert read == texts


def test_a_text_longer_than_a_rapid_string_is_dropped_and_the_next_one_read():
    parser = TextParser()
    assert parser.feed(b"D" * 81 + b"#D 1#") == ["D 1"]
    assert parser.feed(b"D" * 81) == []
    assert parser.feed(b"#D 2#") == ["", "D 2"]


@pytest.mark.parametrize(
    ("text", "answer"),
    [("D 7", (7, "done", "")), ("S 8", (8, "stopped", "")), ("E 9 no such", (9, "refused", "no such"))],
)
def test_the_motion_servers_answers_are_read(text, answer):
    read = codec.decode_motion(text)
    assert (read.number, read.result, read.reason) == answer


@pytest.mark.parametrize("text", ["D", "D 1 2", "E 9", "X 1", "", "D x", "D nan"])
def test_other_answers_of_the_motion_server_are_none(text):
    with pytest.raises(RapidTextError):
        codec.decode_motion(text)


@pytest.mark.parametrize(("flag", "stopped"), [("0", False), ("1", True)])
def test_the_guards_answer_is_read(flag, stopped):
    state = codec.decode_guard(f"P 4 1.5 -2 30.25 0 1 0 0 {flag}")
    assert (state.number, state.pose, state.stopped) == (4, WirePose(1.5, -2.0, 30.25, 0, 1, 0, 0), stopped)


@pytest.mark.parametrize(
    "text", ["P 4 1 2 3 0 1 0 0 2", "P 4 1 2 3 0 1 0 0", "Q 4 1 2 3 0 1 0 0 0", "P 4 1 2 3 0 1 0 0 0 0"]
)
def test_other_answers_of_the_guard_are_none(text):
    with pytest.raises(RapidTextError):
        codec.decode_guard(text)


def test_a_move_is_written_as_the_modules_read_it():
    assert codec.encode_move(3, WirePose(1.0, -2.5, 30.0, 0, 1, 0, 0), 999.0) == (
        b"M 3 1.00 -2.50 30.00 0.00000 1.00000 0.00000 0.00000 999.0#"
    )
    with pytest.raises(RapidTextError, match="at most 999"):
        codec.encode_move(3, WirePose(0, 0, 0), 999.1)
    with pytest.raises(RapidTextError, match="holds 80"):
        codec.encode_move(99999, WirePose(-1234567890.0, -1234567890.0, -1234567890.0, -0.5, 0.5, -0.5, 0.5), 999.0)


def test_a_text_may_fill_a_rapid_string_to_its_last_character():
    """80 characters: of a request, of an answer, and of one that is cut anywhere."""
    wide = WirePose(-12345.0, -12345.0, -123456.0, -0.5, -0.5, -0.5, -0.5)
    assert len(codec.encode_move(12345, wide, 99.0)) == 80
    for text in ("D" * 80, "D" * 79):
        parser = TextParser()
        assert parser.feed(text.encode()) == []
        assert parser.feed(b"#") == [text]
    with pytest.raises(RapidTextError, match="holds 80"):
        codec.encode_move(123456, wide, 99.0)


def test_a_move_may_be_slower_than_a_tenth_of_a_millimetre_per_second():
    assert codec.encode_move(1, WirePose(0, 0, 0), 0.09).endswith(b" 0.1#")
