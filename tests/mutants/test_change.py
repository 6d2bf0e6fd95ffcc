import ast
import subprocess
import sys

import pytest

from tests.mutants.__main__ import ROOT, room_of
from tests.mutants.change import changes, mutant

SAMPLE = "first = attempt == 1\ndead = lost or late\nturn = a * b - c\ncost = 1 - share * hit\n"


def test_comparisons_operators_and_booleans_are_among_the_changes() -> None:
    """The kinds of the four mutants that once lived through the whole fast suite."""
    tree, drawn = ast.parse(SAMPLE), set()
    for node, field, value in list(changes(tree)):
        kept = getattr(node, field)
        setattr(node, field, value)
        drawn.add(ast.unparse(node))
        setattr(node, field, kept)
    assert {"attempt != 1", "lost and late", "a * b + c", "1 + share * hit"} <= drawn


@pytest.mark.parametrize(
    ("compared", "both"), [("len(way) < 3", True), ("tried_n >= left_n", True), ("slid_mm < most_mm", False)]
)
def test_the_edge_itself_is_tried_between_whole_numbers_only(compared: str, both: bool) -> None:
    compare = ast.parse(compared, mode="eval").body
    assert sum(field == "ops" for node, field, _ in changes(compare) if node is compare) == 1 + both


def test_the_guard_of_a_zip_stays() -> None:
    assert list(changes(ast.parse("zip(left, right, strict=True)"))) == []
    assert len(list(changes(ast.parse("sorted(left, reverse=True)")))) == 1


def test_a_size_that_follows_from_the_others_stays_open() -> None:
    made = [
        ast.unparse(value) for _, _, value in changes(ast.parse("points.reshape(-1)")) if isinstance(value, ast.AST)
    ]
    assert len(list(changes(ast.parse("points.reshape(-1)")))) == len(made) == 1, "its sign alone is changed"
    assert len(list(changes(ast.parse("points.take(-1)")))) == 2


FORGETS = """
import sys
from robot_client.insertion import geometry, lease, machine
from tests.mutants.forked import forget, importers
forget("robot_client.insertion.lease", importers())
from robot_client.insertion import geometry as same, lease as other, machine as anew
sys.exit(not (same is geometry and other is not lease and anew is not machine and anew.ClockMap is other.ClockMap))
"""


def test_what_imports_a_changed_module_is_imported_anew_and_nothing_else() -> None:
    assert subprocess.run([sys.executable, "-c", FORGETS], cwd=ROOT, check=False).returncode == 0


def test_each_mutant_differs_from_the_module_in_one_line() -> None:
    path = ROOT / "service/perception/slip/grasp.py"
    original = ast.unparse(ast.parse(path.read_text())).splitlines()
    for number, _ in enumerate(changes(ast.parse(path.read_text()))):
        changed = mutant(ROOT, path, number).source.splitlines()
        assert sum(old != new for old, new in zip(original, changed, strict=True)) == 1


@pytest.mark.parametrize(
    ("module", "folder"),
    [
        ("service/decision/belief.py", "tests/service/decision"),
        ("robot_client/robots/abb_egm/watch.py", "tests/robot_client/robots/abb_egm"),
        ("robot_client/cli/none/driver.py", "tests/robot_client/cli"),
    ],
)
def test_a_mutant_meets_the_room_of_its_own_room(module: str, folder: str) -> None:
    assert room_of(ROOT, module) == folder
