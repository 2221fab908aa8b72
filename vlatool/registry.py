"""(kind, name) -> the class in ``vlatool/<kind>/<name>.py``, or what another package adds; loads only what is named.

One thing, one file, found by its file name: there is no list to edit. A file whose name starts with ``_`` and a
sub-package are shared parts of the folder, not entries. Another package adds an entry by an entry point of the group
``vlatool.<kind>`` (``vlatool.quantize``, ``vlatool.engines``, ...) that names a module or a class in it; vlatool's own
come first.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import pkgutil
import traceback
from importlib import metadata
from types import ModuleType

from vlatool.errors import PluginError, UsageError, VlatoolError, instead, nearest

PACKAGES = {
    "engines": "vlatool.runtime.engines", "commands": "vlatool.cli", "render": "vlatool.render.formats",
    "sections": "vlatool.render.sections", "losses": "vlatool.training.losses",
    "hints": "vlatool.training.hints", "motion": "vlatool.motion.metrics",
    "videos": "vlatool.render.videos", "control": "vlatool.runtime.control"}  # fmt: skip
"""Kind -> the package that holds its files, where that has another name."""
NOUNS = {
    "quantize": "quantization method", "prune": "pruning method", "distill": "distillation method",
    "evaluate": "evaluation", "export": "export target", "sources": "kind of source", "data": "format of recordings",
    "render": "report format", "motion": "metric of motion", "videos": "format of videos",
    "workers": "launcher of workers", "control": "controller",
}  # fmt: skip
_FOREIGN: dict[type, str] = {}
"""Class of another package -> ``kind.name``, once it was loaded."""


def package_of(kind: str) -> str:
    """Return the package that holds the files of ``kind`` (``"engines"`` live in the runtime)."""
    return PACKAGES.get(kind, f"vlatool.{kind}")


def noun_of(kind: str) -> str:
    """Return what an entry of a kind is called in messages."""
    return NOUNS.get(kind, kind.removesuffix("s"))


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
    entries = {entry.name.replace("-", "_"): entry for entry in metadata.entry_points(group=f"vlatool.{kind}")}
    return {name: entry for name, entry in entries.items() if name not in own}


def module(kind: str, name: str) -> ModuleType:
    """Import the file of one entry.

    Raises:
        UsageError: for an unknown entry; suggests the nearest one.
        PluginError: when another package adds it, and cannot be imported.
    """
    own_name = name.replace("-", "_")
    if own_name in _own(kind):
        return importlib.import_module(f"{package_of(kind)}.{own_name}")
    if own_name not in plugins(kind):
        raise UsageError(
            f"Unknown {noun_of(kind)} '{name}'; {nearest(own_name, names(kind))}.", instead(own_name, names(kind))
        )
    entry = plugins(kind)[own_name]
    try:
        return importlib.import_module(entry.module)
    except VlatoolError:
        raise
    except Exception as error:  # the seam: another package's code may raise anything
        raise _plugin_error(entry, f"cannot be imported: {type(error).__name__}: {error}") from error


def load(kind: str, name: str) -> type:
    """Return the one public class that the file of an entry defines, or that an entry point names.

    Raises:
        UsageError: for an unknown entry.
        PluginError: when another package adds it, and it is not such a class.
        TypeError: when the file defines no public class, or several (a fault of the file).
    """
    source = module(kind, name)
    own_name = name.replace("-", "_")
    entry = plugins(kind)[own_name] if source.__name__ != f"{package_of(kind)}.{own_name}" else None
    if entry is None:
        return _only_class(source)
    try:
        entry_class = getattr(source, entry.attr) if entry.attr else _only_class(source)
        if not inspect.isclass(entry_class):
            raise TypeError(f"{entry.value} is not a class")
    except (AttributeError, TypeError) as error:
        raise _plugin_error(entry, f"does not name a class: {error}") from error
    _FOREIGN[entry_class] = f"{kind}.{own_name}"
    return entry_class


def entry_of(entry_class: type) -> str:
    """Return ``kind.name`` of a class that ``load`` returned, or of one in a file of its kind."""
    return _FOREIGN.get(entry_class) or ".".join(entry_class.__module__.split(".")[-2:])


def all_plugins() -> dict[str, list[str]]:
    """Return other package (``acme 1.2``) -> what it adds, as ``kind.name``."""
    added: dict[str, list[str]] = {}
    for group in sorted(metadata.entry_points().groups):
        for entry in plugins(group.partition(".")[2]).values() if group.startswith("vlatool.") else ():
            added.setdefault(_title(entry), []).append(f"{group.partition('.')[2]}.{entry.name}")
    return added


def owner(module_name: str) -> str:
    """Return which other package a module is from (``acme 1.2``); empty for vlatool's own, and for any that adds none.

    Args:
        module_name: Of any module of that package.
    """
    top = module_name.partition(".")[0]
    groups = (group for group in metadata.entry_points().groups if group.startswith("vlatool.") and top != "vlatool")
    entries = (entry for group in groups for entry in metadata.entry_points(group=group))
    return next((_title(entry) for entry in entries if entry.module.partition(".")[0] == top), "")


def blamed(error: BaseException) -> str:
    """Return which other package's code an exception came out of, the last before vlatool's own or a library's."""
    frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    owners = [(name.partition(".")[0] == "vlatool", owner(name)) for name in frames]
    return next((other for own, other in reversed(owners) if own or other), "")


def complaint(package: str, kind: str, message: str) -> tuple[str, str]:
    """Return message and fix of the error of another package whose code raised an exception."""
    words = f"The package {package}, which adds to vlatool, fails: {kind}: {message}."
    return words, "report it to its authors, with the traceback of VLATOOL_DEBUG=1"


def _own(kind: str) -> list[str]:
    spec = importlib.util.find_spec(package_of(kind))
    if spec is None or spec.submodule_search_locations is None:
        return []
    files = pkgutil.iter_modules(spec.submodule_search_locations)
    return sorted(file.name for file in files if not (file.ispkg or file.name.startswith("_")))


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


def _plugin_error(entry: metadata.EntryPoint, what: str) -> PluginError:
    return PluginError(
        f"The package {_title(entry)}, which adds '{entry.name}' ({entry.group}), {what}.",
        "report it to its authors, or uninstall it",
    )
