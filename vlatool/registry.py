"""(kind, name) -> the class in ``vlatool/<kind>/<name>.py``; loads only the file that is named.

One thing, one file, found by its file name: there is no list to edit. A file whose name starts with ``_`` is a shared
part of its folder, not an entry.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
from types import ModuleType

from vlatool.errors import UsageError, nearest


def package_of(kind: str) -> str:
    """Return the package that holds the files of ``kind`` (``"engines"`` live in the runtime)."""
    return "vlatool.runtime.engines" if kind == "engines" else f"vlatool.{kind}"


def names(kind: str) -> list[str]:
    """List the entries of a kind by file name, importing none of them.

    Example:
        >>> "static_int8" in names("quantize")
        True
    """
    spec = importlib.util.find_spec(package_of(kind))
    if spec is None or spec.submodule_search_locations is None:
        return []
    found = pkgutil.iter_modules(spec.submodule_search_locations)
    return sorted(module.name for module in found if not module.name.startswith("_"))


def module(kind: str, name: str) -> ModuleType:
    """Import the file of one entry.

    Raises:
        UsageError: when there is no such entry; names the nearest one.
    """
    wanted = name.replace("-", "_")
    if wanted not in names(kind):
        raise UsageError(f"There is no {kind.removesuffix('s')} '{name}'; {nearest(wanted, names(kind))}.")
    return importlib.import_module(f"{package_of(kind)}.{wanted}")


def load(kind: str, name: str) -> type:
    """Return the one public class that the file of an entry defines.

    Raises:
        UsageError: when there is no such entry.
        TypeError: when the file defines no public class, or several (a fault of the file).
    """
    source = module(kind, name)
    classes = [
        value
        for key, value in vars(source).items()
        if inspect.isclass(value) and value.__module__ == source.__name__ and not key.startswith("_")
    ]
    if len(classes) != 1:
        raise TypeError(f"{source.__name__} must define exactly one public class, it defines {len(classes)}")
    return classes[0]
