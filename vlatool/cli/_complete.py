"""Shell completion: names of profiles, engines and samples, and paths. Reads names alone."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from typer.core import TyperGroup

from vlatool import registry
from vlatool.bundle.bundle import MANIFEST
from vlatool.report import REPORT

MAX_NAMES = 2000
"""Names of a folder that are looked at."""
_CLICK: Any = TyperGroup.__mro__[1].__module__.rpartition(".")[0]
CompletionItem: Any = importlib.import_module(f"{_CLICK}.shell_completion").CompletionItem
"""From the click inside typer, or the one that it imports, depending on its version."""


def profiles(incomplete: str) -> list[str]:
    """Return names of profiles, or YAML files and folders."""
    from vlatool.hardware.profile import SUFFIXES, profile_names

    files = _paths(incomplete, lambda path: path.endswith(tuple(SUFFIXES))) if os.sep in incomplete else []
    return [*_starting(profile_names(), incomplete), *files]


def platforms(incomplete: str) -> list[str]:
    """Return names of robot platforms."""
    from vlatool.hardware.platforms import platform_names

    return _starting(platform_names(), incomplete)


def engines(incomplete: str) -> list[str]:
    """Return names of engines."""
    return _starting(registry.names("engines"), incomplete)


def buses(incomplete: str) -> list[str]:
    """Return names of buses."""
    return _starting(registry.names("buses"), incomplete)


def worlds(incomplete: str) -> list[str]:
    """Return names of simulated robots."""
    return _starting(registry.names("worlds"), incomplete)


def samples(incomplete: str) -> list[str]:
    """Return the shapes of policies that can be made."""
    return _starting((name.replace("_", "-") for name in registry.names("samples")), incomplete)


def precisions(incomplete: str) -> list[str]:
    """Return the precisions that profiles have figures for."""
    return _starting(("float32", "float16", "bfloat16", "float8", "int8", "int4"), incomplete)


def bundles(incomplete: str) -> list[str]:
    """Return bundles, and folders that may hold some."""
    return _paths(incomplete, _is_bundle)


def reports(incomplete: str) -> list[str]:
    """Return bundles, reports, and folders that may hold some."""
    return _paths(incomplete, lambda path: _is_bundle(path) or path.endswith(".json") or _holds(path, REPORT))


def sources(incomplete: str) -> list[str]:
    """Return bundles, what a source is certain to read, and folders that may hold some."""
    return _paths(incomplete, lambda path: _is_bundle(path) or registry.is_certain("sources", path))


def policies(incomplete: str) -> list[str]:
    """Return folders that a source is certain to read, and folders that may hold some."""
    return _paths(incomplete, lambda path: os.path.isdir(path) and registry.is_certain("sources", path))


OF_FIELDS: dict[str, Callable[[str], list[str]]] = {
    "engine": engines, "against": bundles, "baseline": bundles, "policy": policies,
}  # fmt: skip
"""Field of a stage -> what completes it."""


def items(values: list[str]) -> list[Any]:
    """Return what click takes from a group."""
    return [CompletionItem(value) for value in values]


def _starting(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]


def _is_bundle(path: str) -> bool:
    return _holds(path, MANIFEST)


def _holds(path: str, name: str) -> bool:
    return os.path.isfile(os.path.join(path, name))


def _paths(incomplete: str, accepts: Callable[[str], bool]) -> list[str]:
    """Return the matching paths that are accepted; folders that are not end in a slash."""
    paths = []
    for path in _beginning(incomplete):
        if accepts(path):
            paths.append(path)
        elif os.path.isdir(path):
            paths.append(path + os.sep)
    return paths


def _beginning(incomplete: str) -> Iterator[str]:
    """Return the paths that begin like an incomplete one; hidden files only where it begins with a dot."""
    folder, start = os.path.split(incomplete)
    with contextlib.suppress(OSError):
        for name in sorted(os.listdir(folder or os.curdir))[:MAX_NAMES]:
            if name.startswith(start) and (start or not name.startswith(".")):
                yield os.path.join(folder, name)
