"""Identity of the code behind a result: one hash of a module, all its imports from this project, objects and sensors.

An earlier run is resumed only if this hash has not changed. Comments and docstrings do not count.
"""

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("simulation", "service", "robot_client", "training", "export")


def sources_sha256(module: str, root: Path = ROOT) -> str:
    """SHA-256 of everything that ``module`` runs, from the present files; nothing is imported."""
    digest = hashlib.sha256()
    for path, code in sorted(_closure(module, root).items()):
        digest.update(str(path.relative_to(root)).encode() + code)
    for path in sorted([*root.glob("simulation/objects/*.toml"), *root.glob("service/sensors/*.toml")]):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


class _Bare(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        """Without docstrings."""
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return ast.Pass() if text else node


def _closure(module: str, root: Path) -> dict[Path, bytes]:
    """The code of a module's file and of all its imports from this project, by path."""
    files: dict[Path, bytes] = {}
    waiting = [module]
    while waiting:
        path = _file_of(waiting.pop(), root)
        if path is not None and path not in files:
            files[path], imported = _code(path.read_text(encoding="utf-8"))
            waiting += imported
    return files


@cache
def _code(text: str) -> tuple[bytes, tuple[str, ...]]:
    """A file's code without docstrings and comments, and its imports."""
    tree = ast.parse(text)
    imported = tuple(_imported(tree))
    return ast.dump(_Bare().visit(tree)).encode(), imported


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _file_of(module: str, root: Path) -> Path | None:
    if module.split(".", maxsplit=1)[0] not in PACKAGES:
        return None
    place = root.joinpath(*module.split("."))
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)
