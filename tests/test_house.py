"""The project stays small: short files, short functions, folders with few modules, names that say what they hold."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("simulation", "training", "export", "reporting", "service", "robot_client", "tactile_insertion")
FILES = [
    path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")) if not path.stem.endswith("_pb2")
]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
VAGUE = {"told", "said", "seen", "found", "judge", "judged", "verdict", "plate", "seat"}
KEYS = {"robot_client/session/commission/wiring.py: said"}  # of files that cells have written
MOST_MODULES, MOST_LINES, MOST_FUNCTION_LINES, P90_FUNCTION_LINES, MOST_COLUMNS = 12, 300, 50, 20, 100


def functions(path: Path) -> list[tuple[int, str]]:
    """Length in lines and place of every function of a file."""
    return [
        (node.end_lineno - node.lineno + 1, f"{path.relative_to(ROOT)}:{node.lineno} {node.name}")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_folder_holds_more_than_a_dozen_modules(package):
    modules = Counter(
        path.parent for path in FILES if path.name != "__init__.py" and path.is_relative_to(ROOT / package)
    )
    assert {str(folder): count for folder, count in modules.items() if count > MOST_MODULES} == {}


def test_no_file_is_longer_than_300_lines():
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in FILES + TESTS}
    assert {name: length for name, length in lengths.items() if length > MOST_LINES} == {}


def test_functions_do_one_thing():
    lengths = sorted(length for path in FILES for length in functions(path))
    assert [place for length, place in lengths if length > MOST_FUNCTION_LINES] == []
    assert lengths[int(0.9 * len(lengths))][0] <= P90_FUNCTION_LINES


def bound(path: Path) -> Iterator[str]:
    """Every name that a file gives to a variable, an attribute, a parameter, a function or a class."""
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name


def test_names_say_what_they_hold():
    vague = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in FILES + TESTS
        for name in bound(path)
        if name.strip("_").lower() in VAGUE
    }
    assert sorted(vague - KEYS) == []


def test_prose_wraps_at_a_hundred_columns():
    """But for code, tables, pictures and headings, which have no line ends to choose, and single long words."""
    pages = [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(page for p in PACKAGES for page in (ROOT / p).rglob("*.md")),
    ]
    wide = [
        f"{page.relative_to(ROOT)}: {line}"
        for page in pages
        for block in page.read_text().split("```")[::2]
        for line in block.splitlines()
        if len(line) > MOST_COLUMNS and " " in line.strip() and not line.lstrip().startswith(("|", "!", "#", "<"))
    ]
    assert wide == []
