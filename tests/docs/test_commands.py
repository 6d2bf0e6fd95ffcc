"""Every command in the documentation exists, accepts the shown options, and runs, or states why no test can run it."""

import contextlib
import importlib
import io
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from unittest import mock

import pytest

from robot_client.settings import Settings, load_settings
from tactile_insertion.commands import COMMANDS
from tests.docs.commands import ROOT, Block, blocks, pages, shell_blocks, spans

MAKEFILE = (ROOT / "Makefile").read_text()
TARGETS = set(re.findall(r"^([a-z][a-z-]*):", MAKEFILE, re.MULTILINE))
VARIABLES = set(re.findall(r"\$\(([A-Z_]+)\)|\b([A-Z_]+) \?=", MAKEFILE))
OWN = {"service", "robot_client", "simulation", "training", "export"}
PAST = "CHANGELOG.md"  # it names options that are gone


@cache
def help_of(*words: str) -> str:
    """Output of `python -m PACKAGE [COMMAND] --help`, here in one process; the command must exit with 0."""
    package, *rest = words
    screen, status = io.StringIO(), 0
    with contextlib.redirect_stdout(screen), mock.patch.dict(os.environ, COLUMNS="200", NO_COLOR="1"):
        try:
            status = importlib.import_module(f"{package}.__main__").main([*rest, "--help"])
        except SystemExit as end:
            status = end.code
    assert not status, f"python -m {' '.join(words)} --help ended with {status}"
    return screen.getvalue()


def check_module(words: list[str]) -> None:
    """`python -m PACKAGE COMMAND --option`: the package is ours, the command and every option are in its help."""
    package, *rest = words
    assert package in OWN, f"python -m {package} is none of our packages"
    if not rest or rest == ["--help"]:
        help_of(package)
        return
    command = [package] if rest[0].startswith("-") else [package, rest[0]]
    text = help_of(*command)
    if len(rest) > 1 and rest[1] in inner_commands(text):
        text = help_of(*command, rest[1])
    for word in rest:
        option = word.split("=")[0]
        if option.startswith("--"):
            assert re.search(rf"{re.escape(option)}(?![\w-])", text), f"{' '.join(command)} has no option {option}"


def inner_commands(text: str) -> list[str]:
    """The commands of a command, as its usage lists them: `scene {identify,fit,judge}`."""
    listed = re.search(r"usage: .*?\{([\w,-]+)\}\s*$", text.split("\n\n", maxsplit=1)[0])
    return listed[1].split(",") if listed else []


def check_command(words: list[str]) -> None:
    """`tactile-insertion COMMAND --option`: the command is ours, and every option is in its help."""
    name, *rest = words
    if not name.startswith("-"):
        assert name in COMMANDS, f"tactile-insertion has no command {name}"
        check_module([COMMANDS[name].package, COMMANDS[name].name, *rest])


def check_make(words: list[str]) -> None:
    """`make TARGET NAME=value`: the target exists and something reads the variable."""
    known = {name for pair in VARIABLES for name in pair if name}
    for word in words:
        if "=" in word:
            assert word.split("=")[0] in known, f"no rule of the Makefile reads {word.split('=')[0]}"
        elif not word.startswith("-"):
            assert word in TARGETS, f"make has no target {word}"


def without_assignments(words: list[str]) -> list[str]:
    """The command after `NAME=value` prefixes."""
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    return words


@pytest.mark.parametrize("block", shell_blocks(), ids=lambda block: block.name)
def test_every_command_exists_and_takes_the_options_shown(block: Block):
    for command in block.commands():
        words = without_assignments(command)
        check(words)
        assert words[0] not in OWN, f"{words[0]} is a package: python -m {words[0]}"


def check(words: list[str]) -> None:
    """A command of ours, whichever way it is called; those of others pass."""
    if words[:1] == ["make"]:
        check_make(words[1:])
    elif words[:1] == ["tactile-insertion"] and len(words) > 1:
        check_command(words[1:])
    elif len(words) > 2 and Path(words[0]).name.startswith("python") and words[1] == "-m" and words[2] in OWN:
        check_module(words[2:])


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_and_option_named_in_a_sentence_exists(page: Path):
    if page.name == PAST:
        return
    for span in spans(page):
        check(without_assignments(span.split()))
        for option in re.findall(r"(?<!\S)--[a-z][\w-]*", span):
            assert option in all_options(), f"{page.name}: no command has the option {option}"


@cache
def all_options() -> set[str]:
    """Every option in the help of any command."""
    calls = [(command.package, command.name) for command in COMMANDS.values()]
    calls += [(*call, inner) for call in calls for inner in inner_commands(help_of(*call))]
    return set(re.findall(r"--[a-z][\w-]*", "\n".join(help_of(*call) for call in [*calls, *((own,) for own in OWN)])))


def test_whatever_is_not_executed_says_why():
    for block in shell_blocks():
        assert block.why_not is None or len(block.why_not) > 10, f"{block.name}: say why it is not executed"


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file(page: Path):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if not re.match(r"[a-z]+:", target):
            assert (page.parent / target).exists(), f"{page.name} points to {target}, which is absent"


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_every_python_block_is_python(page: Path):
    for block in blocks(page):
        if block.language == "python":
            compile(block.text, block.name, "exec")


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The shell of a person in the repository with this interpreter active; what a command writes goes elsewhere."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "OUT": str(tmp_path_factory.mktemp("runs"))}


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("block", [b for b in shell_blocks() if b.why_not is None], ids=lambda block: block.name)
def test_every_command_runs(block: Block, environment: dict[str, str]):
    script = f"set -euo pipefail\n{block.script}"
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, cwd=ROOT, env=environment, timeout=1800, check=False
    )
    assert done.returncode == 0, f"{block.name} ended with {done.returncode}:\n{(done.stdout + done.stderr)[-2000:]}"


def configured(tmp_path: Path, *pages: str) -> Settings:
    """The tables that these pages teach, in one file."""
    tables = [b.text for page in pages for b in blocks(ROOT / page) if b.language == "toml"]
    (tmp_path / "cell.toml").write_text("\n".join(tables))
    return load_settings(tmp_path / "cell.toml")


def test_the_robot_configuration_in_the_first_hour_is_accepted(tmp_path: Path):
    settings = configured(tmp_path, "docs/first_hour.md")
    assert settings.limits.max_attempts == 3
    assert settings.task.gap_width_mm == 56.0


def test_the_tables_of_the_client_of_the_cycle_and_of_an_object_are_accepted(tmp_path: Path):
    assert configured(tmp_path, "robot_client/README.md", "docs/cycle.md").cycle.plc.start == "diTactileStart"
    assert configured(tmp_path, "docs/my_object.md").task.object == "soap"


def test_no_command_stands_in_an_indented_block_that_nobody_tries():
    for page in pages():
        prose = re.sub(r"^( *)```.*?^\1```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        assert not re.findall(r"^(?: {4,}|\t)(?:make|python|tactile-insertion|pip|sudo|curl) .*", prose, re.MULTILINE)


def test_the_first_hour_calibrates_before_it_starts_the_service_that_refuses_raw_cameras():
    commands = [words for b in shell_blocks() if b.page == "docs/first_hour.md" for words in b.commands()]
    (started,) = [k for k, words in enumerate(commands) if words[2:4] == ["service", "run"]]
    (calibrated,) = [k for k, words in enumerate(commands) if words[2:4] == ["service", "calibrate"]]
    assert calibrated < started
    made = commands[calibrated][commands[calibrated].index("--out") + 1]
    assert commands[started][commands[started].index("--calibration") + 1] == made
