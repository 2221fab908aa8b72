"""Files of a policy's folder that its code imports, according to its import statements."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

HIDDEN_CALLS = {"__import__", "exec", "eval", "compile"}
BY_FILE = {"spec_from_file_location", "run_path", "SourceFileLoader"}
"""What imports a file by its path."""
HIDDEN_NAMES = BY_FILE | {
    "import_module", "run_module", "load_source", "find_spec",
}  # fmt: skip
"""What imports without an import statement: then any Python file beside the code may be imported."""


def imported_files(roots: Iterable[Path], folder: Path) -> set[Path]:
    """Return the Python files that some code runs: its own and what it imports from its folder, however far.

    Where code imports in another way than by an import statement, ``import_module("name")`` or
    ``spec_from_file_location(..., HERE / "name.py")``, every Python file of the folder counts.

    Args:
        roots: files of code in the folder.
        folder: where imports begin; packages below it are followed.
    """
    files: set[Path] = set()
    waiting = [root for root in roots if root.is_file()]
    while waiting:
        file = waiting.pop()
        if file in files:
            continue
        files.add(file)
        try:
            tree = ast.parse(file.read_bytes())
        except (SyntaxError, ValueError, RecursionError):  # importing it says what is wrong
            files.update(folder.glob("*.py"))
            continue
        if _has_hidden_imports(tree):
            waiting += folder.glob("*.py")
        waiting += [imported for names, base in _imports(tree, file, folder) for imported in _files(names, base)]
    return files


def _imports(tree: ast.AST, file: Path, folder: Path) -> Iterator[tuple[tuple[str, ...], Path]]:
    """Yield what is imported: parts of a module's name and where they begin."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield tuple(alias.name.split(".")), folder
        elif isinstance(node, ast.ImportFrom):
            base = file.parents[node.level - 1] if 0 < node.level <= len(file.parents) else folder
            parts = tuple(filter(None, (node.module or "").split(".")))
            for alias in node.names:
                yield (*parts, alias.name), base
        elif isinstance(node, ast.Call):
            for name in _literal_import(node):
                yield tuple(name.replace("/", ".").split(".")), folder


def _files(parts: tuple[str, ...], base: Path) -> Iterator[Path]:
    """Yield the files of a module and of the packages around it, where they are in the folder."""
    path = base
    if (path / "__init__.py").is_file() and parts == ("*",):
        yield path / "__init__.py"
    for part in parts:
        yield from (file for file in (path / f"{part}.py", path / part / "__init__.py") if file.is_file())
        path /= part


def _literal_import(node: ast.Call) -> list[str]:
    """Return the modules that a call names by a literal: ``import_module("name")``, or a file ``name.py``."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in BY_FILE:
        literals = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
        return [text.removesuffix(".py") for text in literals if isinstance(text, str) and text.endswith(".py")]
    literal = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else None
    alone = name == "import_module" and len(node.args) == 1 and isinstance(literal, str)
    return [str(literal)] if alone and not str(literal).startswith(".") else []


def _has_hidden_imports(tree: ast.AST) -> bool:
    """Return whether code imports, or may import, what no statement names."""
    known = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call) and _literal_import(node)}
    for node in ast.walk(tree):
        if id(node) in known:
            continue
        if isinstance(node, ast.Name) and node.id in HIDDEN_CALLS | HIDDEN_NAMES:
            return True
        if isinstance(node, ast.Attribute) and (node.attr in HIDDEN_NAMES or _is_path(node)):
            return True
    return False


def _is_path(node: ast.Attribute) -> bool:
    return node.attr in ("path", "meta_path", "path_hooks") and getattr(node.value, "id", "") == "sys"
