import ast

import pytest

from tests.mutants.__main__ import ROOT, room_of
from tests.mutants.change import changes, mutant

# These four lived through the whole fast suite once.
NAMED = [
    ("service/decision/controllers.py", "attempt != 1"),
    ("service/session/state_machine.py", "message.attempt != last + 1 and (not decided)"),
    ("robot_client/robots/abb_egm/codec.py", "cx * cy * cz - sx * sy * sz"),
    ("service/decision/belief.py", "1 + SURE_INSERT * float(hits[row, column])"),
]


@pytest.mark.parametrize(("module", "after"), NAMED)
def test_the_mutants_that_once_lived_are_among_those_drawn(module: str, after: str) -> None:
    tree, drawn = ast.parse((ROOT / module).read_text()), []
    for node, field, value in list(changes(tree)):
        kept = getattr(node, field)
        setattr(node, field, value)
        drawn.append(ast.unparse(node))
        setattr(node, field, kept)
    assert after in drawn


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
        ("robot_client/robots/dry_run/driver.py", "tests/robot_client/robots"),
    ],
)
def test_a_mutant_meets_the_room_of_its_own_room(module: str, folder: str) -> None:
    assert room_of(module) == folder
