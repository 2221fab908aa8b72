"""(kind, name) -> the class in ``vlatool/<kind>/<name>.py``, or one of another package; imports only what is requested.

Each entry is one file, found by its file name, so there is no list to edit. Files whose names start with ``_`` and
sub-packages are shared by the folder and are not entries. Another package adds an entry with an entry point of the
group ``vlatool.<kind>`` (``vlatool.quantize``, ``vlatool.engines``, ...) that names a module or a class in it;
vlatool's own entries take precedence.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import inspect
from collections.abc import Iterator, Mapping
from enum import IntEnum
from types import ModuleType
from typing import TYPE_CHECKING, Any

from vlatool.errors import PluginError, UsageError, VlatoolError

if TYPE_CHECKING:
    from importlib import metadata

PACKAGE_OF_KIND = {
    "engines": "vlatool.runtime.engines", "commands": "vlatool.cli", "render": "vlatool.render.formats",
    "sections": "vlatool.render.sections", "losses": "vlatool.training.losses",
    "hints": "vlatool.training.hints", "motion": "vlatool.motion.metrics",
    "videos": "vlatool.render.videos", "control": "vlatool.runtime.control",
    "claims": "vlatool.gate.claims"}  # fmt: skip
"""Kind -> package of its files, for kinds whose package has a different name."""
NOUNS = {
    "quantize": "quantization method", "prune": "pruning method", "distill": "distillation method",
    "evaluate": "evaluation", "export": "export target", "sources": "kind of source", "data": "format of recordings",
    "render": "report format", "motion": "metric of motion", "videos": "format of videos",
    "workers": "launcher of workers", "control": "controller", "serving": "protocol of vlatool serve",
    "controllers": "robot controller", "buses": "bus", "worlds": "simulated robot",
}  # fmt: skip
_PLUGIN_CLASSES: dict[type, str] = {}
"""Loaded class of another package -> ``kind.name``."""


class Claim(IntEnum):
    """How sure an entry is that it can read what the user names.

    ``claims`` of an entry looks only at names and first bytes: it is called for every path that a shell completes.
    """

    NONE = 0
    MAYBE = 1
    CERTAIN = 2


def package_of(kind: str) -> str:
    """Return the package with the files of a kind (those of ``"engines"`` are in the runtime)."""
    return PACKAGE_OF_KIND.get(kind, f"vlatool.{kind}")


def noun_of(kind: str) -> str:
    """Return the noun for an entry of a kind in messages."""
    return NOUNS.get(kind, kind.removesuffix("s"))


def names(kind: str) -> list[str]:
    """Return the names of a kind's entries, including those of other packages, without importing any.

    Example:
        >>> "static_int8" in names("quantize")
        True
    """
    return sorted({*_builtin_names(kind), *plugins(kind)})


@functools.cache
def plugins(kind: str) -> dict[str, metadata.EntryPoint]:
    """Return the entries of a kind from other packages: name -> entry point; vlatool's own names are not replaced."""
    own = _builtin_names(kind)
    entries = {entry.name.replace("-", "_"): entry for entry in _entry_points().select(group=f"vlatool.{kind}")}
    return {name: entry for name, entry in entries.items() if name not in own}


def module(kind: str, name: str) -> ModuleType:
    """Import the module of an entry.

    Raises:
        UsageError: for an unknown entry; suggests the most similar one.
        PluginError: when it is another package's and cannot be imported.
    """
    own_name = name.replace("-", "_")
    if _is_builtin(kind, own_name):
        return importlib.import_module(f"{package_of(kind)}.{own_name}")
    if own_name not in plugins(kind):
        raise UsageError.unknown(f"Unknown {noun_of(kind)} '{name}'", own_name, names(kind))
    entry = plugins(kind)[own_name]
    try:
        return importlib.import_module(entry.module)
    except VlatoolError:
        raise
    except Exception as error:  # another package's code may raise anything
        raise _plugin_error(entry, f"cannot be imported: {type(error).__name__}: {error}") from error


def load(kind: str, name: str) -> type:
    """Return the only public class in the file of an entry, or the class that an entry point names.

    Raises:
        UsageError: for an unknown entry.
        PluginError: when it is another package's and has no such class.
        TypeError: when a file of vlatool's own does not define exactly one public class.
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
    _PLUGIN_CLASSES[entry_class] = f"{kind}.{own_name}"
    return entry_class


def loadable(kind: str) -> Iterator[tuple[str, Any]]:
    """Yield the name and the class of each entry that can be imported; ``doctor`` lists the others."""
    for name in names(kind):
        with contextlib.suppress(PluginError):
            yield name, load(kind, name)


def is_certain(kind: str, named: Any) -> bool:
    """Return whether any entry is certain that it can read what the user names."""
    return any(entry.claims(named) is Claim.CERTAIN for _, entry in loadable(kind))


def claimant(kind: str, named: Any, error: type[VlatoolError]) -> Any:
    """Return the entry for what the user names: the one that is certain, else the one that answers maybe, else None.

    Raises:
        VlatoolError: (of the type ``error``) when several are equally sure.
    """
    claims = {name: (entry, Claim(entry.claims(named))) for name, entry in loadable(kind)}
    surest = max((claim for _, claim in claims.values()), default=Claim.NONE)
    found = {name: entry for name, (entry, claim) in claims.items() if claim is surest is not Claim.NONE}
    if len(found) > 1:
        raise error(
            f"{named} is ambiguous; each {noun_of(kind)} of these reads it: {_requirements(found)}.",
            "name the file that is meant, or move what the other one reads elsewhere; a package that is not needed can "
            "be uninstalled",
        )
    return next(iter(found.values()), None)


def requirements(kind: str) -> str:
    """Return what each entry of a kind reads, for messages: ``onnx (a .onnx file)``."""
    entries = dict(loadable(kind))
    broken = [f"{name} (cannot be imported, vlatool doctor says why)" for name in names(kind) if name not in entries]
    return "; ".join([_requirements(entries), *broken])


def _requirements(entries: Mapping[str, Any]) -> str:
    return "; ".join(f"{name} ({entry.needs})" for name, entry in entries.items())


def values(kind: str, *classes: type) -> list[Any]:
    """Return all instances of some classes in the files of a kind, those in vlatool's own files first.

    Raises:
        PluginError: when a file of another package cannot be imported, or has none.
    """
    found: list[Any] = []
    for name in (*_builtin_names(kind), *plugins(kind)):
        held = [value for value in vars(module(kind, name)).values() if isinstance(value, classes)]
        if not held and name in plugins(kind):
            raise _plugin_error(plugins(kind)[name], f"holds no {noun_of(kind)}")
        found += held
    return found


def entry_of(entry_class: type) -> str:
    """Return ``kind.name`` of a class that ``load`` returned or that is defined in a file of its kind."""
    return _PLUGIN_CLASSES.get(entry_class) or ".".join(entry_class.__module__.split(".")[-2:])


def all_plugins() -> dict[str, list[str]]:
    """Return the other packages that extend vlatool: ``acme 1.2`` -> its entries as ``kind.name``."""
    added: dict[str, list[str]] = {}
    for group in sorted(_entry_points().groups):
        for entry in plugins(group.partition(".")[2]).values() if group.startswith("vlatool.") else ():
            added.setdefault(_title(entry), []).append(f"{group.partition('.')[2]}.{entry.name}")
    return added


def plugin_of(module_name: str) -> str:
    """Return the other package to which a module belongs (``acme 1.2``); empty if it does not extend vlatool.

    Args:
        module_name: name of any module of that package.
    """
    top = module_name.partition(".")[0]
    points = _entry_points()
    groups = (group for group in points.groups if group.startswith("vlatool.") and top != "vlatool")
    entries = (entry for group in groups for entry in points.select(group=group))
    return next((_title(entry) for entry in entries if entry.module.partition(".")[0] == top), "")


def package_at_fault(error: BaseException) -> str:
    """Return the other package that caused an exception: the owner of the innermost frame that is not a library's."""
    import traceback  # a robot without a fault does without

    frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    owners = [(name.partition(".")[0] == "vlatool", plugin_of(name)) for name in frames]
    return next((other for own, other in reversed(owners) if own or other), "")


def plugin_failure(package: str, kind: str, message: str) -> tuple[str, str]:
    """Return the message and the fix for an exception that another package's code raised."""
    words = f"The package {package}, which adds to vlatool, fails: {kind}: {message}."
    return words, "report it to its authors, with the traceback of VLATOOL_DEBUG=1"


def _entry_points() -> Any:
    """Return the entry points of all packages. Their library is imported only here: a robot waits for it at start."""
    from importlib import metadata

    return metadata.entry_points()


def _is_builtin(kind: str, name: str) -> bool:
    """Return whether one name is among ``_builtin_names``, which takes longer."""
    package = package_of(kind)
    if not name.isidentifier() or name.startswith("_") or importlib.util.find_spec(package) is None:
        return False  # a kind of which other packages alone have entries has no package here
    spec = importlib.util.find_spec(f"{package}.{name}")
    return spec is not None and spec.submodule_search_locations is None


def _builtin_names(kind: str) -> list[str]:
    import pkgutil  # a robot names what it wants

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
