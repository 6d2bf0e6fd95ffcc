"""What a terminal gets of foreign texts: every character visible, none of them a command."""

from hypothesis import given
from hypothesis import strategies as st

from service.contract.text import printable


@given(st.text() | st.text(st.characters(categories=["Cc", "Cf", "Cs", "Co", "Zl", "Zp"])))
def test_whatever_comes_is_one_visible_line(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    shown.encode()
    if text.isprintable():
        assert shown == text


def test_commands_of_a_terminal_are_written_out() -> None:
    assert printable("\x1b[2Jall is well\r\x9b1A\u202e") == "\\x1b[2Jall is well\\r\\x9b1A\\u202e"
