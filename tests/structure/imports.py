"""Which module of vlatool imports which, read from the syntax trees: nothing is imported."""

from __future__ import annotations

import ast
import functools
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "vlatool"


@dataclass(frozen=True, order=True)
class Import:
    """One import.

    Args:
        importer: The module that has it.
        imported: The module that it names.
        names: What is taken from that module; empty for the module itself.
        line: Where it stands.
    """

    importer: str
    imported: str
    names: tuple[str, ...] = ()
    line: int = 0


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Return each module's dotted name and file."""
    found = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(root: Path = ROOT) -> list[Import]:
    """Return the imports of vlatool's modules by each other, those inside functions and for types alone among them."""
    known = modules(root)
    return sorted({each for name, path in known.items() for each in _imports(name, path, known)})


def _imports(importer: str, path: Path, known: dict[str, Path]) -> Iterator[Import]:
    for node in _nodes(path.read_bytes()):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in known:
                    yield Import(importer, alias.name, line=node.lineno)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            inside = [alias.name for alias in node.names if f"{node.module}.{alias.name}" in known]
            for name in inside:
                yield Import(importer, f"{node.module}.{name}", line=node.lineno)
            if taken := tuple(alias.name for alias in node.names if alias.name not in inside):
                yield Import(importer, str(node.module), taken, node.lineno)


@functools.cache
def _nodes(source: bytes) -> list[ast.Import | ast.ImportFrom | ast.Call]:
    """Return what may import something, read once from each text."""
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, (ast.Import, ast.ImportFrom, ast.Call))]


def room(module: str, known: dict[str, Path]) -> str:
    """Return the package that a module is in; a package is in itself."""
    return module if known[module].name == "__init__.py" else module.rpartition(".")[0]


def private_imports(root: Path = ROOT) -> list[Import]:
    """Return the imports of what starts with ``_`` from outside of the package that holds it."""
    known = modules(root)
    return [each for each in imports(root) if _foreign(each, known)]


def _foreign(found: Import, known: dict[str, Path]) -> bool:
    names = found.imported.split(".")
    inside = room(found.importer, known) + "."
    hidden = [".".join(names[:at]) + "." for at, name in enumerate(names) if name.startswith("_")]
    if any(not inside.startswith(owner) for owner in hidden):
        return True
    dunder = {"__version__", "__all__"}
    private = [name for name in found.names if name.startswith("_") and name not in dunder]
    return bool(private) and found.importer != found.imported


def circles(root: Path = ROOT) -> list[list[str]]:
    """Return the groups of modules that import each other, directly or through each other (Tarjan, 1972)."""
    arrows: dict[str, set[str]] = {name: set() for name in modules(root)}
    for each in imports(root):
        arrows[each.importer].add(each.imported)
    return [sorted(group) for group in _components(arrows) if len(group) > 1]


def _components(arrows: dict[str, set[str]]) -> list[list[str]]:
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    groups: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for target in sorted(arrows[node]):
            if target not in index:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], index[target])
        if low[node] == index[node]:
            at = stack.index(node)
            groups.append(stack[at:])
            del stack[at:]

    for name in sorted(arrows):
        if name not in index:
            visit(name)
    return groups


def named_libraries(libraries: Collection[str], root: Path = ROOT, engines: str = "runtime/engines/") -> list[str]:
    """Return where an inference library is imported or asked for, outside of the engines: ``file:line``.

    That is an import statement, or a call of a function with the library's name as its first argument, such as
    ``require("openvino", ...)`` or ``importlib.import_module``; a method that needs no import, such as ``dict.get``,
    counts as well.
    """
    found = []
    for path in modules(root).values():
        if engines not in path.as_posix():
            place, nodes = path.relative_to(root).as_posix(), _nodes(path.read_bytes())
            asking = (node for node in nodes if any(name.partition(".")[0] in libraries for name in _asked_for(node)))
            found += [f"{place}:{node.lineno}" for node in asking]
    return found


def _asked_for(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        return [node.module or ""]
    if isinstance(node, ast.Call) and node.args and isinstance(first := node.args[0], ast.Constant):
        return [str(first.value)]
    return []
