"""One small change to a module: an operator, comparison, boolean, constant or flag at one place in its syntax tree."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

SWAPS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
EDGES = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
UNTOUCHED = {"annotation", "returns", "decorator_list"}
GUARD = "strict"  # keyword of `zip` that only catches programming errors: either way the same program


class Mutant(NamedTuple):
    """A changed module: its path from the root, the line, the expression before and after, and the whole source."""

    module: str
    line: int
    before: str
    after: str
    source: str


def changes(tree: ast.AST) -> Iterator[tuple[ast.AST, str, object]]:
    """Every change as node, field and new value; annotations, decorators and messages stay as they are."""
    yield from ((tree, field, value) for field, value in _of_node(tree))
    for field, value in ast.iter_fields(tree):
        if field not in UNTOUCHED and not isinstance(tree, ast.JoinedStr):
            for child in value if isinstance(value, list) else [value]:
                if _open_size(tree, child):
                    yield child, "op", ast.UAdd()
                elif isinstance(child, ast.AST) and getattr(child, "arg", None) != GUARD:
                    yield from changes(child)


def _of_node(node: ast.AST) -> Iterator[tuple[str, object]]:
    match node:
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            yield "op", SWAPS[type(op)]()
        case ast.Compare(ops=[first, *rest]):
            yield "ops", [SWAPS[type(first)](), *rest]
            if type(first) in EDGES and any(map(_counted, (node.left, *node.comparators[:1]))):
                yield "ops", [EDGES[type(first)](), *rest]
        case ast.UnaryOp(op=ast.USub()):
            yield "op", ast.UAdd()
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            yield "test", ast.UnaryOp(ast.Not(), test)
        case ast.Constant(value=bool(value)):
            yield "value", not value
        case ast.Constant(value=int(value)):
            yield "value", value + 1
        case ast.Constant(value=float(value)):
            yield "value", value * 1.5 + 0.1


def _open_size(call: object, argument: object) -> bool:
    """Whether an argument is the -1 of ``reshape``: any negative size stands for the one that follows from the rest."""
    match call, argument:
        case ast.Call(func=ast.Attribute(attr="reshape")), ast.UnaryOp(op=ast.USub(), operand=ast.Constant()):
            return True
    return False


def _counted(side: ast.expr) -> bool:
    """Whether an expression is a whole number by its looks: a literal, a length, or a name that ends as a count does.

    Measured quantities are equal to their limit once in 10^16 draws, so there ``<`` and ``<=`` are the same program.
    """
    match side:
        case ast.Constant(value=int(value)):
            return not isinstance(value, bool)
        case ast.Call(func=ast.Name(id="len")):
            return True
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name.endswith(("_n", "attempt", "attempts"))
    return False


def mutant(root: Path, path: Path, number: int) -> Mutant:
    """The module with one of its ``changes`` made."""
    tree = ast.parse(path.read_text())
    node, field, value = list(changes(tree))[number]
    before = ast.unparse(node).splitlines()[0]
    setattr(node, field, value)
    return Mutant(
        str(path.relative_to(root)), node.lineno, before, ast.unparse(node).splitlines()[0], ast.unparse(tree)
    )
