"""One command reaches every package, explains itself in 80 columns and refuses wrong input in one line."""

import importlib
import json
import os
import re
import subprocess
import sys

import pytest

import robot_client.cli.main
import service.__main__
import simulation.__main__
import training.cli.commands
from tactile_insertion.command_line import main, usage
from tactile_insertion.commands import COMMANDS


def test_help_lists_every_command_within_80_columns():
    lines = usage().splitlines()
    assert max(map(len, lines)) <= 80
    assert all(any(line.split()[:1] == [name] for line in lines) for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_helps_from_its_own_package_within_80_columns(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        sys.exit(main([name, "--help"]))
    assert ended.value.code in (0, None)
    out = capsys.readouterr().out
    assert out.startswith(f"usage: tactile-insertion {name} ")
    assert "python -m" not in out
    assert max(map(len, out.splitlines())) <= 80


def test_what_a_command_prints_fits_80_columns(capsys):
    assert main(["models"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(("words", "code"), [(["models"], 1), (["--help"], 0), (["versions", "--help"], 0)])
def test_a_reader_may_leave_before_the_end(unbuffered, words, code):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "tactile_insertion", *words]
    done = subprocess.run(
        command,
        stdout=writer,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (code, b"")


def test_it_reaches_every_command_of_every_room():
    reached = {(command.package, command.name) for command in COMMANDS.values()}
    rooms = {"simulation": simulation.__main__.COMMANDS, "service": service.__main__.COMMANDS}
    rooms |= {"training": training.cli.commands.COMMANDS}
    rooms["robot_client"] = re.findall(r"^    (\w+) +\S", robot_client.cli.main._parser().format_help(), re.MULTILINE)
    assert {(room, name) for room, commands in rooms.items() for name in commands} <= reached
    assert {package for package, _ in reached} == {*rooms, "export"}


def test_a_misspelt_command_is_refused_with_the_nearest_one(capsys):
    assert main(["evalute"]) == 2
    assert "'evaluate'" in capsys.readouterr().err


def test_nothing_heavy_is_imported_to_list_the_commands():
    heavy = ["torch", "numba", "cv2", "onnxruntime", "fastapi", "numpy"]
    code = (
        "import sys, json; from tactile_insertion.command_line import main; main(['--help']);"
        f"print(json.dumps([m for m in {heavy!r} if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert json.loads(done.stdout.splitlines()[-1]) == []


def test_a_missing_installation_is_named_with_its_remedy(monkeypatch, capsys):
    def without_torch(_name):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(importlib, "import_module", without_torch)
    assert main(["train", "configuration.toml"]) == 2
    assert "pip install 'tactile-insertion[training]'" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["probe", "teapot"], ["models", "nowhere"], ["verify", "nowhere"]])
def test_wrong_input_is_one_line_and_exit_code_2(words, capsys):
    try:
        code = main(words)
    except SystemExit as ended:  # the option parser's own refusal
        code = ended.code
    assert code == 2
    error = capsys.readouterr().err
    assert error.strip()
    assert "Traceback" not in error


def test_bash_completes_the_commands():
    script = subprocess.run(
        [sys.executable, "-m", "tactile_insertion", "--print-completion", "bash"],
        capture_output=True, text=True, check=True, timeout=60,
    ).stdout  # fmt: skip
    words = "$(complete -p tactile-insertion | cut -d\\' -f2)"
    ask = f'{script}\ncompgen -W "{words}" eval'
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["evaluate"]


def test_an_unknown_shell_is_refused(capsys):
    assert main(["--print-completion", "tcsh"]) == 2
    assert "bash, zsh, fish" in capsys.readouterr().err
