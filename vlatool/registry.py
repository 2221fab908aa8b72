"""(kind, name) -> the class in ``vlatool/<kind>/<name>.py``, or what another package brings; loads only what is named.

One thing, one file, found by its file name: there is no list to edit. A file whose name starts with ``_`` is a shared
part of its folder, not an entry. Another package adds an entry by an entry point of the group ``vlatool.<kind>``
(``vlatool.quantize``, ``vlatool.engines``, ...) that names a module or a class in it; vlatool's own come first.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import pkgutil
from importlib import metadata
from types import ModuleType

from vlatool.errors import PluginError, UsageError, VlatoolError, nearest

PACKAGES = {
    "engines": "vlatool.runtime.engines", "commands": "vlatool.cli", "render": "vlatool.render.formats",
    "sections": "vlatool.render.sections",
}  # fmt: skip
"""Kind -> the package that holds its files, where that has another name."""
NOUNS = {
    "quantize": "quantization method", "prune": "pruning method", "distill": "distillation method",
    "evaluate": "evaluation", "export": "export target", "sources": "kind of source", "data": "format of recordings",
    "render": "report format",
}  # fmt: skip
_FOREIGN: dict[type, str] = {}
"""Class of another package -> ``kind.name``, once it was loaded."""


def package_of(kind: str) -> str:
    """Return the package that holds the files of ``kind`` (``"engines"`` live in the runtime)."""
    return PACKAGES.get(kind, f"vlatool.{kind}")


def names(kind: str) -> list[str]:
    """List the entries of a kind by file name, importing none of them, and those of other packages.

    Example:
        >>> "static_int8" in names("quantize")
        True
    """
    return sorted({*_own(kind), *plugins(kind)})


@functools.cache
def plugins(kind: str) -> dict[str, metadata.EntryPoint]:
    """Return what other packages add to a kind: name -> entry point. A name that vlatool has itself is not taken."""
    own = _own(kind)
    found = {entry.name.replace("-", "_"): entry for entry in metadata.entry_points(group=f"vlatool.{kind}")}
    return {name: entry for name, entry in found.items() if name not in own}


def module(kind: str, name: str) -> ModuleType:
    """Import the file of one entry.

    Raises:
        UsageError: when there is no such entry; names the nearest one.
        PluginError: when another package brings it, and cannot be imported.
    """
    wanted = name.replace("-", "_")
    if wanted in _own(kind):
        return importlib.import_module(f"{package_of(kind)}.{wanted}")
    if wanted not in plugins(kind):
        noun = NOUNS.get(kind, kind.removesuffix("s"))
        raise UsageError(f"Unknown {noun} '{name}'; {nearest(wanted, names(kind))}.")
    entry = plugins(kind)[wanted]
    try:
        return importlib.import_module(entry.module)
    except VlatoolError:
        raise
    except Exception as error:  # the seam: another package's code raises what it likes
        raise _blamed(entry, f"cannot be imported: {type(error).__name__}: {error}") from error


def load(kind: str, name: str) -> type:
    """Return the one public class that the file of an entry defines, or that an entry point names.

    Raises:
        UsageError: when there is no such entry.
        PluginError: when another package brings it, and it is no such class.
        TypeError: when the file defines no public class, or several (a fault of the file).
    """
    source = module(kind, name)
    wanted = name.replace("-", "_")
    entry = plugins(kind)[wanted] if source.__name__ != f"{package_of(kind)}.{wanted}" else None
    if entry is None:
        return _only_class(source)
    try:
        found = getattr(source, entry.attr) if entry.attr else _only_class(source)
        if not inspect.isclass(found):
            raise TypeError(f"{entry.value} is no class")
    except (AttributeError, TypeError) as error:
        raise _blamed(entry, f"does not name a class: {error}") from error
    _FOREIGN[found] = f"{kind}.{wanted}"
    return found


def entry_of(found: type) -> str:
    """Return ``kind.name`` of a class that ``load`` returned, or of one in a file of its kind."""
    return _FOREIGN.get(found) or ".".join(found.__module__.split(".")[-2:])


def all_plugins() -> dict[str, list[str]]:
    """Return other package (``acme 1.2``) -> what it adds, as ``kind.name``."""
    found: dict[str, list[str]] = {}
    for group in sorted(metadata.entry_points().groups):
        for entry in plugins(group.partition(".")[2]).values() if group.startswith("vlatool.") else ():
            found.setdefault(_title(entry), []).append(f"{group.partition('.')[2]}.{entry.name}")
    return found


def owner(module_name: str) -> str:
    """Return which other package brings a module (``acme 1.2``); empty for vlatool's own, and for any that brings none.

    Args:
        module_name: Of any module of that package.
    """
    top = module_name.partition(".")[0]
    groups = (group for group in metadata.entry_points().groups if group.startswith("vlatool.") and top != "vlatool")
    entries = (entry for group in groups for entry in metadata.entry_points(group=group))
    return next((_title(entry) for entry in entries if entry.module.partition(".")[0] == top), "")


def _own(kind: str) -> list[str]:
    spec = importlib.util.find_spec(package_of(kind))
    if spec is None or spec.submodule_search_locations is None:
        return []
    found = pkgutil.iter_modules(spec.submodule_search_locations)
    return sorted(each.name for each in found if not each.name.startswith("_"))


def _only_class(source: ModuleType) -> type:
    classes = [
        value
        for key, value in vars(source).items()
        if inspect.isclass(value) and value.__module__ == source.__name__ and not key.startswith("_")
    ]
    if len(classes) != 1:
        raise TypeError(f"{source.__name__} must define exactly one public class, it defines {len(classes)}")
    return classes[0]


def _title(entry: metadata.EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value


def _blamed(entry: metadata.EntryPoint, what: str) -> PluginError:
    return PluginError(
        f"The package {_title(entry)}, which brings '{entry.name}' ({entry.group}), {what}.",
        "tell its authors, or uninstall it",
    )
