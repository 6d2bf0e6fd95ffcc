"""Foreign texts on a terminal: every character visible, none of them a command."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract.text import fitted, printable


@given(st.text() | st.text(st.characters(categories=["Cc", "Cf", "Cs", "Co", "Zl", "Zp"])))
def test_whatever_comes_is_one_visible_line(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    shown.encode()
    if text.isprintable():
        assert shown == text


def test_commands_of_a_terminal_are_written_out() -> None:
    assert printable("\x1b[2Jall is well\r\x9b1A\u202e") == "\\x1b[2Jall is well\\r\\x9b1A\\u202e"


@pytest.mark.parametrize(
    ("line", "fits"),
    [
        ("  short", ["  short"]),
        (
            "    arm link    " + "datagrams 1872, " * 6,
            ["    arm link    datagrams 1872,", " " * 16 + "datagrams 1872,"],
        ),
        (
            "  HOLD  service: refused: the object has turned",
            ["  HOLD  service: refused: the", " " * 8 + "object has turned"],
        ),
        ("  log    /a/path/that/is/longer/than/the/width", ["  log    /a/path/that/is/longer/than/the/width"]),
    ],
)
def test_a_long_line_goes_on_below_what_it_says_of_its_label(line, fits):
    assert fitted(line, width=32).splitlines()[:2] == fits
