"""`tactile-insertion COMMAND [options]`: finds the package of a command and runs it there.

Nothing is imported before a command is known, so that `--help` is instant and a light command stays light. Exit codes:
0 done, 1 not done, 2 invalid input or a missing installation, 130 interrupted.
"""

import contextlib
import difflib
import importlib
import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence

from service import __version__
from tactile_insertion.commands import COMMANDS, GROUPS, Command

DONE, WRONG_INPUT, INTERRUPTED = 0, 2, 130
WIDTH = 80
EXTRAS = {"training": "training", "export": "training"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; invalid input gives one line on standard error and exit code 2."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in {"-h", "--help"}:
        _show(usage())
        return DONE if words else WRONG_INPUT
    if words[0] == "--version":
        print(f"tactile-insertion {__version__}")
        return DONE
    if words[0] == "--print-completion":
        return _print_completion(words[1:])
    name, *rest = words
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        return _refuse(f"no command {name!r}; {hint}`tactile-insertion --help` lists them")
    return _run(name, COMMANDS[name], rest)


def usage() -> str:
    """The help text: one line per command, within 80 columns."""
    lines = ["usage: tactile-insertion COMMAND [options]", ""]
    for title, commands in GROUPS.items():
        lines += [f"{title}:", *(f"  {name:<16} {command.help}" for name, command in commands.items()), ""]
    lines += [
        "`tactile-insertion COMMAND --help` tells the options; `--version` the version;",
        "`--print-completion bash|zsh|fish` prints a completion script for your shell.",
        "exit codes: 0 done, 1 not done, 2 wrong input",
    ]
    return "\n".join(lines)


def _run(name: str, command: Command, rest: list[str]) -> int:
    try:
        entry: Callable[[list[str]], int] = importlib.import_module(f"{command.package}.__main__").main
        if {"-h", "--help"} & set(rest):
            return _help(entry, [command.name, *rest])
        return int(entry([command.name, *rest]))
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if missing in {known.package for known in COMMANDS.values()} or not missing:
            raise  # a fault of ours, not of the installation
        extra = EXTRAS.get(command.package)
        remedy = f"pip install 'tactile-insertion[{extra}]'" if extra else "pip install tactile-insertion"
        return _refuse(f"{name} needs the package {missing!r}: {remedy}")
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ValueError, OSError) as error:
        if os.environ.get("TACTILE_TRACEBACK"):
            raise
        from service.contract.text import printable

        return _refuse(printable(f"{name}: {' '.join(str(error).split())}"))


def _help(entry: Callable[[list[str]], int], words: list[str]) -> int:
    """A command's own help, with the commands named as here and long paragraphs wrapped to the terminal."""
    written = io.StringIO()
    try:
        with contextlib.redirect_stdout(written):
            return int(entry(words))
    finally:
        width = min(WIDTH, shutil.get_terminal_size().columns)
        lines = _named_as_here(written.getvalue()).splitlines()
        _show("\n".join(line if len(line) <= width else textwrap.fill(line, width) for line in lines))


def _named_as_here(text: str) -> str:
    """The text with each `python -m PACKAGE NAME` as the `tactile-insertion` command."""
    for name, command in COMMANDS.items():
        text = re.sub(rf"python -m {command.package} {command.name}\b", f"tactile-insertion {name}", text)
    return text


def _show(text: str) -> None:
    """Print a text of which a reader may want the beginning only, as with ``| head``."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _print_completion(shell: list[str]) -> int:
    """A script for the shell that completes the commands, and then files."""
    names = " ".join(COMMANDS)
    scripts = {
        "bash": f'complete -o default -W "{names}" tactile-insertion',
        "zsh": f"#compdef tactile-insertion\n_arguments '1:command:({names})' '*:file:_files'",
        "fish": f"complete -c tactile-insertion -n __fish_use_subcommand -f -a '{names}'",
    }
    if len(shell) != 1 or shell[0] not in scripts:
        return _refuse(f"--print-completion {' '.join(shell)}: expected one of {', '.join(scripts)}")
    print(scripts[shell[0]])
    return DONE


def _refuse(sentence: str) -> int:
    print(f"tactile-insertion: {sentence}", file=sys.stderr)
    return WRONG_INPUT
