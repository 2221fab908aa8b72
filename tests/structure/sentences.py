"""Find decisions that rest on a sentence: a comparison with a text for a person, or a look into one.

A verdict is a value, and the sentence about it is made at the end. In the syntax trees of the rooms where verdicts are
reached and shown, these expressions are found: ``==``, ``in``, ``startswith`` and the like, and patterns of ``re``,
where one side is a text of several words (a literal, or a constant of any module of vlatool) or is read from an
attribute or a key that holds text for a person (``note``, ``message``, ...).
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

from imports import ROOT, modules

ROOMS = ("gate", "accuracy", "optimize", "cli", "render")
TEXTS = {
    "sentence", "sentences", "message", "reason", "reasons", "note", "notes", "fix", "remedy", "summary", "warnings",
    "words", "found",
}  # fmt: skip
"""Attributes and keys that hold text for a person."""
METHODS = {"startswith", "endswith", "partition", "rpartition", "split", "find", "index", "count"}
PATTERNS = {"match", "search", "fullmatch", "findall"}
COMPARISONS = (ast.Eq, ast.NotEq, ast.In, ast.NotIn)
NOT_VERDICTS = {
    (
        "accuracy/motion_comparison.py",
        "drop.note.partition(WORST_TASK_PREFIX)",
    ): "reads the name of a task where the same file writes it",
    (
        "cli/_failure.py",
        "error.fix.startswith(ON_A_ROBOT)",
    ): "chooses a remedy; the class of an error is part of --json",
    ("cli/_side_by_side.py", "str(path) in error.message"): "adds the path where a message lacks it",
    ("cli/_side_by_side.py", "item.where == HERE"): "the name of a machine",
    ("render/_view.py", "where == 'this host'"): "the name of a machine",
    ("optimize/timings.py", "what != OWN_SET"): "the name of an instruction set",
    ("optimize/evidence.py", "name.endswith(TEACHER)"): "the name of a table",
    ("render/sections/details.py", "title not in (UNDER, SHOWN)"): "the name of a table",
    ("render/sections/details.py", "title.startswith(AGAINST_BASELINE)"): "the name of a table",
    ("render/_format.py", "part.startswith(NO_INTERVAL)"): "shows the part of a note that the report's format marks",
    ("render/_format.py", "measurement.note.split('; ')"): "the same",
}
"""(file, expression) -> why no verdict rests on it."""


def decisions(root: Path = ROOT) -> list[str]:
    """Return ``file:line: expression`` of every decision that rests on a sentence."""
    trees = {name: ast.parse(path.read_bytes()) for name, path in modules(root).items()}
    messages = {name: set(_messages(tree)) for name, tree in trees.items()}
    found = []
    for name, path in modules(root).items():
        if name.split(".")[1:2] not in [[room] for room in ROOMS]:
            continue
        file = path.relative_to(root / "vlatool").as_posix()
        known = messages[name] | set(_imported(trees[name], messages))
        found += [f"{file}:{node.lineno}: {ast.unparse(node)}" for node in ast.walk(trees[name])
                  if isinstance(node, ast.expr) and (file, ast.unparse(node)) not in NOT_VERDICTS
                  and any(_is_text(operand, known) for operand in _operands(node))]  # fmt: skip
    return found


def _messages(tree: ast.Module) -> Iterator[str]:
    """Yield the constants of a module whose value is text of several words."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and _is_message(statement.value):
            yield from (target.id for target in statement.targets if isinstance(target, ast.Name))


def _imported(tree: ast.Module, messages: Mapping[str, set[str]]) -> Iterator[str]:
    """Yield the names under which a module has such constants of other modules, or of a module that it imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names = messages.get(node.module or "", set())
            yield from (alias.asname or alias.name for alias in node.names if alias.name in names)
            for alias in node.names:
                yield from messages.get(f"{node.module}.{alias.name}", ())


def _is_message(value: ast.AST) -> bool:
    if isinstance(value, ast.JoinedStr):
        return any(map(_is_message, value.values))
    return isinstance(value, ast.Constant) and isinstance(value.value, str) and len(value.value.split()) > 1


def _operands(node: ast.expr) -> list[ast.expr]:
    """Return what an expression compares or looks into; nothing for one that does neither."""
    if isinstance(node, ast.Compare) and isinstance(node.ops[0], COMPARISONS):
        return [node.left, *node.comparators]
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return []
    if isinstance(node.func.value, ast.Name) and node.func.value.id == "re":
        return node.args if node.func.attr in PATTERNS else []
    return [node.func.value, *node.args] if node.func.attr in METHODS else []


def _is_text(node: ast.expr, messages: set[str]) -> bool:
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        return any(_is_text(item, messages) for item in node.elts)
    if isinstance(node, ast.Attribute):
        return node.attr in TEXTS | messages
    if isinstance(node, ast.Subscript):
        return _is_text(node.value, messages) or (isinstance(node.slice, ast.Constant) and node.slice.value in TEXTS)
    return _is_message(node) or (isinstance(node, ast.Name) and node.id in messages)
