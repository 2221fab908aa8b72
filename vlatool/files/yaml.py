"""YAML files that users write, read with errors that name the file and the problem.

A file is bounded in bytes, depth and nodes before any value is built: aliases are counted as what they expand to, so
that a few lines cannot become gigabytes. Only plain values are read; duplicate keys are refused.
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
from vlatool.files.limits import check_limit, limit

PLAIN_TAGS = ("map", "seq", "str", "int", "float", "bool", "null", "timestamp", "merge", "value")
"""Tags of the values that are read."""
TAG = "tag:yaml.org,2002:"
CORRECT_LINE = "correct it in that line; text with ': ', '#' or a leading '*' needs quotes"
WRITE_PAIRS = "write it as lines of NAME: VALUE"
MAX_CACHED_CHARACTERS = 1 << 16
"""Length up to which the result of parsing a text is cached."""


def read_yaml(path: Path, what: str, raised: type[InputError]) -> Any:
    """Return the value in a YAML file.

    Args:
        what: name of the file, as the subject of a sentence: ``The recipe out/recipe.yaml``.

    Raises:
        InputError: of the class ``raised``, when the file is missing, cannot be read, is not YAML, is larger than the
            limits ``yaml_bytes``, ``yaml_depth`` and ``yaml_nodes`` allow, or has a key twice.
    """
    yaml = require("yaml", "build")
    try:
        text = _text(path, what, raised)
        parse = _parse_cached if len(text) <= MAX_CACHED_CHARACTERS else _parse
        return copy.deepcopy(parse(text, what, raised, (limit("yaml_depth"), limit("yaml_nodes"))))
    except OSError as error:
        raise raised(
            f"{what} cannot be read: {error.strerror or error}.", "check its path, and that this user may read it"
        ) from error
    except UnicodeDecodeError as error:
        raise raised(f"{what} is not valid YAML: it cannot be read as UTF-8: {error}.", "save it in UTF-8") from error
    except ValueError as error:
        if "integer string conversion" not in str(error):
            raise raised(f"{what} is not valid YAML: {' '.join(str(error).split())[:400]}.", CORRECT_LINE) from error
        raise raised(
            f"{what} has a whole number of more than {sys.get_int_max_str_digits():,} digits.", "write it as 1e30"
        ) from error
    except (yaml.YAMLError, TypeError, LookupError, AttributeError, OverflowError) as error:
        raise raised(f"{what} is not valid YAML: {' '.join(str(error).split())[:400]}.", CORRECT_LINE) from error


def _parse(text: str, what: str, raised: type[InputError], _limits: tuple[int, int]) -> Any:
    yaml = require("yaml", "build")
    loader = yaml.SafeLoader(text)
    loader.compose_node = _limit_depth(loader, what, raised)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _check_nodes(node, what, raised)
        return loader.construct_document(node)
    finally:
        loader.dispose()


_parse_cached: Any = functools.lru_cache(32)(_parse)
"""Its results must not be modified; a command reads the profiles of all boards several times."""


def read_mapping(path: Path, what: str, raised: type[InputError]) -> dict[str, Any]:
    """Return the mapping in a YAML file; raises ``raised`` when ``read_yaml`` does, or the file has something else."""
    data = read_yaml(path, what, raised)
    if data is None:
        raise raised(f"{what} is empty; it must be a mapping.", WRITE_PAIRS)
    if not isinstance(data, dict):
        raise raised(f"{what} must be a mapping; got {type(data).__name__}.", WRITE_PAIRS)
    odd = [key for key in data if not isinstance(key, str)]
    if odd:
        raise raised(
            f"{what} has the key {str(odd[0])[:80]!r}, a {type(odd[0]).__name__}; keys are names.",
            "write the key in quotes",
        )
    return data


def _text(path: Path, what: str, raised: type[InputError]) -> str:
    """Read a regular file within the limit; a pipe would never end."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as stream:
        status = os.fstat(stream.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise raised(f"{what} cannot be read: it is not a regular file.", "name the file itself")
        check_limit("yaml_bytes", status.st_size, what, raised)
        return stream.read(limit("yaml_bytes") + 1).decode("utf-8")


def _limit_depth(loader: Any, what: str, raised: type[InputError]) -> Any:
    """Return a ``compose_node`` that refuses deep nesting before Python's recursion limit does."""
    compose, depth = loader.compose_node, [0]

    def compose_node(parent: Any, index: Any) -> Any:
        depth[0] += 1
        check_limit("yaml_depth", depth[0], what, raised)
        try:
            return compose(parent, index)
        finally:
            depth[0] -= 1

    return compose_node


def _check_nodes(root: Any, what: str, raised: type[InputError]) -> None:
    """Refuse too many nodes after expansion of aliases, nodes that contain themselves, and tags that are not plain."""
    sizes: dict[int, int] = {}
    open_: set[int] = set()

    def size(node: Any) -> int:
        if id(node) in open_:
            raise raised(
                f"{what} has an alias inside the value it refers to{_line(node)}.", "write the value out in its place"
            )
        if id(node) not in sizes:
            open_.add(id(node))
            _check_node(node, what, raised)
            sizes[id(node)] = 1 + sum(size(part) for part in _parts(node))
            check_limit("yaml_nodes", sizes[id(node)], what, raised)
            open_.discard(id(node))
        return sizes[id(node)]

    size(root)


def _check_node(node: Any, what: str, raised: type[InputError]) -> None:
    kind = node.tag.removeprefix(TAG)
    if kind not in PLAIN_TAGS or not node.tag.startswith(TAG):
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
    """Return the direct children of a node."""
    if node.id == "mapping":
        return [part for pair in node.value for part in pair]
    return list(node.value) if node.id == "sequence" else []


def _line(node: Any) -> str:
    return f" (line {node.start_mark.line + 1})" if node.start_mark else ""
