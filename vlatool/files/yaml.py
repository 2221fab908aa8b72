"""YAML files that people write, read with errors that say which file and what is wrong with it.

A file is bounded in bytes, depth and nodes before any value is built: aliases of aliases are counted as what they stand
for, so that a few lines cannot become gigabytes. Only plain values are read; a key that stands twice is refused.
"""

from __future__ import annotations

import copy
import functools
import os
import stat
import sys
from pathlib import Path
from typing import Any

from vlatool.errors import InputError, require
from vlatool.files.limits import check, limit

PLAIN = ("map", "seq", "str", "int", "float", "bool", "null", "timestamp", "merge", "value")
"""Kinds of values that are read."""
TAG = "tag:yaml.org,2002:"
CORRECT = "correct it in that line; text with ': ', '#' or a leading '*' needs quotes"
PAIRS = "write it as lines of NAME: VALUE"
SHORT = 1 << 16
"""Characters of a text that is parsed once and remembered."""


def read_yaml(path: Path, what: str, raised: type[InputError]) -> Any:
    """Return what a YAML file holds.

    Args:
        path: The file.
        what: What it is, as the subject of a sentence: ``The recipe out/recipe.yaml``.
        raised: Class of the errors.

    Raises:
        InputError: of the class ``raised``, when the file is missing, cannot be read, is no YAML, is larger than the
            limits ``yaml_bytes``, ``yaml_depth`` and ``yaml_nodes`` allow, or has a key twice.
    """
    yaml = require("yaml", "build")
    try:
        text = _text(path, what, raised)
        parse = _remembered if len(text) <= SHORT else _parsed
        return copy.deepcopy(parse(text, what, raised, (limit("yaml_depth"), limit("yaml_nodes"))))
    except OSError as error:
        raise raised(
            f"{what} cannot be read: {error.strerror or error}.", "check its path, and that this user may read it"
        ) from error
    except UnicodeDecodeError as error:
        raise raised(f"{what} is not valid YAML: it cannot be read as UTF-8: {error}.", "save it in UTF-8") from error
    except ValueError as error:
        if "integer string conversion" not in str(error):
            raise raised(f"{what} is not valid YAML: {' '.join(str(error).split())[:400]}.", CORRECT) from error
        raise raised(
            f"{what} has a whole number of more than {sys.get_int_max_str_digits():,} digits.", "write it as 1e30"
        ) from error
    except (yaml.YAMLError, TypeError, LookupError, AttributeError, OverflowError) as error:
        raise raised(f"{what} is not valid YAML: {' '.join(str(error).split())[:400]}.", CORRECT) from error


def _parsed(text: str, what: str, raised: type[InputError], _limits: tuple[int, int]) -> Any:
    yaml = require("yaml", "build")
    loader = yaml.SafeLoader(text)
    loader.compose_node = _bounded(loader, what, raised)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _check_nodes(node, what, raised)
        return loader.construct_document(node)
    finally:
        loader.dispose()


_remembered: Any = functools.lru_cache(32)(_parsed)
"""What is not to be changed; a command asks several times for the profiles of all boards."""


def read_mapping(path: Path, what: str, raised: type[InputError]) -> dict[str, Any]:
    """Return the mapping of a YAML file, as ``read_yaml`` does.

    Raises:
        InputError: of the class ``raised``, when ``read_yaml`` raises, or the file holds something else.
    """
    data = read_yaml(path, what, raised)
    if data is None:
        raise raised(f"{what} is empty; it must be a mapping.", PAIRS)
    if not isinstance(data, dict):
        raise raised(f"{what} must be a mapping; got {type(data).__name__}.", PAIRS)
    odd = [key for key in data if not isinstance(key, str)]
    if odd:
        raise raised(
            f"{what} has the key {str(odd[0])[:80]!r}, a {type(odd[0]).__name__}; keys are names.",
            "write the key in quotes",
        )
    return data


def _text(path: Path, what: str, raised: type[InputError]) -> str:
    """Read a regular file that is not too large; a pipe would never end."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as stream:
        status = os.fstat(stream.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise raised(f"{what} cannot be read: it is not a regular file.", "name the file itself")
        check("yaml_bytes", status.st_size, what, raised)
        return stream.read(limit("yaml_bytes") + 1).decode("utf-8")


def _bounded(loader: Any, what: str, raised: type[InputError]) -> Any:
    """Return a ``compose_node`` that refuses what is nested too deep before Python does."""
    compose, depth = loader.compose_node, [0]

    def compose_node(parent: Any, index: Any) -> Any:
        depth[0] += 1
        check("yaml_depth", depth[0], what, raised)
        try:
            return compose(parent, index)
        finally:
            depth[0] -= 1

    return compose_node


def _check_nodes(root: Any, what: str, raised: type[InputError]) -> None:
    """Refuse nodes that are too many once each alias is what it stands for, that hold themselves, or are not plain."""
    sizes: dict[int, int] = {}
    open_: set[int] = set()

    def size(node: Any) -> int:
        if id(node) in open_:
            raise raised(
                f"{what} has an alias inside of what it stands for{_line(node)}.", "write the value out in its place"
            )
        if id(node) not in sizes:
            open_.add(id(node))
            _check_node(node, what, raised)
            sizes[id(node)] = 1 + sum(size(part) for part in _parts(node))
            check("yaml_nodes", sizes[id(node)], what, raised)
            open_.discard(id(node))
        return sizes[id(node)]

    size(root)


def _check_node(node: Any, what: str, raised: type[InputError]) -> None:
    kind = node.tag.removeprefix(TAG)
    if kind not in PLAIN or not node.tag.startswith(TAG):
        raise raised(
            f"{what} has a value of the kind {node.tag[:80]!r}{_line(node)}; only plain values are read.",
            "write text, a number, a list or a mapping without a tag",
        )
    seen = set()
    for key, _ in node.value if node.id == "mapping" else ():
        if key.id == "scalar" and key.tag != f"{TAG}merge":
            if (key.tag, key.value) in seen:
                raise raised(f"{what} has the key '{key.value[:80]}' twice{_line(key)}.", "remove one of them")
            seen.add((key.tag, key.value))


def _parts(node: Any) -> list[Any]:
    """Return the nodes directly inside a node."""
    if node.id == "mapping":
        return [part for pair in node.value for part in pair]
    return list(node.value) if node.id == "sequence" else []


def _line(node: Any) -> str:
    return f" (line {node.start_mark.line + 1})" if node.start_mark else ""
