"""Foreign texts on a terminal: every character visible, none of them a command. How a command ends."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract.text import Parser, fitted, printable, run_command


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


def raising(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (FileExistsError(17, "File exists", "runs"), "collect: File exists: runs"),
        (ValueError("--seed -1:\n expected 0 or more"), "collect: --seed -1: expected 0 or more"),
        (ValueError(), "collect: ValueError"),
    ],
)
def test_wrong_input_ends_a_command_with_2_and_one_line(capsys, error, line):
    assert run_command("collect", raising(error)) == 2
    assert capsys.readouterr().err == f"{line}\n"


def test_the_variable_of_tracebacks_shows_where_wrong_input_was_found(monkeypatch):
    monkeypatch.setenv("TACTILE_TRACEBACK", "1")
    with pytest.raises(ValueError, match="of a file"):
        run_command("collect", raising(ValueError("of a file")))


def test_an_error_that_no_input_causes_is_not_taken_for_one():
    with pytest.raises(ValueError, match="a defect"):
        run_command("train", raising(ValueError("a defect")), (OSError,))


def test_an_interrupt_ends_a_command_with_130_and_says_whether_it_goes_on(capsys):
    assert run_command("probe", raising(KeyboardInterrupt())) == 130
    assert run_command("collect", raising(KeyboardInterrupt()), resumes=True) == 130
    lines = capsys.readouterr().err
    assert lines == "probe: interrupted\ncollect: interrupted; the same command goes on\n"


def test_an_unknown_option_of_an_inner_command_is_one_line_with_the_nearest(capsys):
    parser = Parser(prog="tool")
    parser.add_subparsers().add_parser("home", prog="tool home").add_argument("--json", action="store_true")
    with pytest.raises(SystemExit) as ended:
        parser.parse_args(["home", "--jsno"])
    assert ended.value.code == 2
    refusal = (
        "tool home: unrecognized arguments: --jsno; did you mean '--json'? (`tool home --help` tells all options)\n"
    )
    assert capsys.readouterr().err == refusal
