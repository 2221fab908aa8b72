"""Where vlatool makes its errors, found in the syntax trees, and whether each can be without a remedy."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vlatool import errors
from vlatool.errors import VlatoolError

ROOT = Path(errors.__file__).parents[1]
CLASSES = {
    name: value for name, value in vars(errors).items() if isinstance(value, type) and issubclass(value, VlatoolError)
}


@dataclass(frozen=True)
class Made:
    """A call that makes an error.

    Args:
        where: File and line.
        kinds: Names of the classes that it may be of; none where that is not said.
        fix: The expression of the remedy, None where there is none.
        tree: Of the file.
    """

    where: str
    kinds: frozenset[str]
    fix: ast.expr | None
    tree: ast.Module

    @property
    def without_remedy(self) -> bool:
        """Whether neither the call nor the class gives a remedy."""
        if self.kinds and all(name in CLASSES and CLASSES[name].remedy for name in self.kinds):
            return False
        return self.fix is None or _may_be_empty(self.fix, self.tree)


def made(folders: tuple[str, ...] = ("vlatool", "robot")) -> Iterator[Made]:
    """Yield every call that makes an error of ``vlatool.errors``, of whatever class it is."""
    for path in sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py")):
        yield from made_in(path.read_text(encoding="utf-8"), str(path.relative_to(ROOT)))


def made_in(source: str, name: str) -> Iterator[Made]:
    """Yield those of one file."""
    tree = ast.parse(source)
    own = {node.name: _names(node.bases) for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    for scope, call in _calls(tree):
        kinds = _kinds(call.func, scope, own, tree)
        if kinds is not None and not any(isinstance(argument, ast.Starred) for argument in call.args):
            keyword = next((each.value for each in call.keywords if each.arg == "fix"), None)
            fix = call.args[1] if len(call.args) > 1 else keyword
            yield Made(f"{name}:{call.lineno}", kinds, fix, tree)


def _calls(tree: ast.Module) -> Iterator[tuple[list[ast.arg], ast.Call]]:
    """Yield each call with the arguments of the functions around it."""

    def inside(node: ast.AST, arguments: list[ast.arg]) -> Iterator[tuple[list[ast.arg], ast.Call]]:
        for child in ast.iter_child_nodes(node):
            own = arguments
            if isinstance(child, ast.FunctionDef):
                own = [*arguments, *child.args.posonlyargs, *child.args.args, *child.args.kwonlyargs]
            if isinstance(child, ast.Call):
                yield own, child
            yield from inside(child, own)

    return inside(tree, [])


def _names(nodes: list[ast.expr]) -> frozenset[str]:
    return frozenset(part.id for node in nodes for part in ast.walk(node) if isinstance(part, ast.Name))


def _kinds(
    function: ast.expr, scope: list[ast.arg], own: dict[str, frozenset[str]], tree: ast.Module
) -> frozenset[str] | None:
    """Return the classes of errors that a call may be of; None for a call of something else."""
    match function:
        case ast.Name(id=name) | ast.Attribute(value=ast.Name(id="errors"), attr=name) if name in CLASSES:
            return frozenset({name})
        case ast.Name(id=name) if own.get(name, frozenset()) & set(CLASSES):
            return own[name] & frozenset(CLASSES)
        case ast.Name(id=name):
            declared = next((each.annotation for each in reversed(scope) if each.arg == name), None)
            return None if declared is None else _classes_of(declared, tree)
        case ast.Call(func=ast.Name(id="type"), args=[ast.Name(id=name)]) if name in ("error", "first"):
            return frozenset()
    return None


def _classes_of(annotation: ast.expr, tree: ast.Module) -> frozenset[str] | None:
    """Return the classes of errors that ``type[...]``, or a name for that, stands for."""
    alias = next(_values_of(annotation.id, tree), None) if isinstance(annotation, ast.Name) else None
    meant = alias or annotation
    names = _names([meant]) & set(CLASSES)
    return names if names and "type[" in ast.unparse(meant) else None


def _values_of(name: str, tree: ast.Module) -> Iterator[ast.expr]:
    """Yield what a file gives a name: in assignments, and as the default of an argument."""
    for node in ast.walk(tree):
        match node:
            case ast.Assign(targets=[ast.Name(id=target)], value=value) if target == name:
                yield value
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)):
                yield from (
                    value
                    for at, value in zip(targets, values, strict=False)
                    if isinstance(at, ast.Name) and at.id == name
                )
            case ast.AnnAssign(target=ast.Name(id=target), value=ast.expr() as value) if target == name:
                yield value
            case ast.arguments(args=arguments, defaults=defaults):
                pairs = zip(reversed(arguments), reversed(defaults), strict=False)
                yield from (value for argument, value in pairs if argument.arg == name)


def _may_be_empty(fix: ast.expr, tree: ast.Module, deep: int = 4) -> bool:
    """Say whether an expression can be an empty text, as far as the source shows it, names and calls followed."""
    if not deep:
        return False
    match fix:
        case ast.Constant(value=value):
            return not value
        case ast.BoolOp(op=ast.Or(), values=values):
            return _may_be_empty(values[-1], tree, deep - 1)
        case ast.IfExp(body=body, orelse=orelse):
            return any(_may_be_empty(value, tree, deep - 1) for value in (body, orelse))
        case ast.Name(id=name):
            return any(_may_be_empty(value, tree, deep - 1) for value in _values_of(name, tree))
        case ast.Call(func=ast.Name(id=name)) | ast.Call(func=ast.Attribute(value=ast.Name(id="self"), attr=name)):
            return any(_may_be_empty(value, where, deep - 1) for value, where in _returned(name, tree))
    return False


def _returned(name: str, tree: ast.Module) -> Iterator[tuple[ast.expr, ast.Module]]:
    """Yield what a function of the file, or one that it imports from vlatool, returns, and the tree of its file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name == name:
            yield from ((each.value, tree) for each in ast.walk(node) if isinstance(each, ast.Return) and each.value)
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("vlatool."):
            path = ROOT / f"{str(node.module).replace('.', '/')}.py"
            if any(name == (each.asname or each.name) for each in node.names) and path.is_file():
                yield from _returned(name, ast.parse(path.read_text(encoding="utf-8")))
