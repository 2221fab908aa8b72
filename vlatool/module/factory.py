"""Import of the function that ``path.py:make`` or ``package.module:make`` names."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from vlatool.errors import InputError, MissingExtra, SourceError, VlatoolError, pip_install
from vlatool.files.printable import message_of
from vlatool.module.bytecode import ignore_bytecode
from vlatool.user_code.children import exit_error

CORRECT_CODE = "correct what fails; VLATOOL_DEBUG=1 shows where it was raised"
"""Fix for code of a user that raises, where nothing more is known."""

OWN_NAME = "vlatool_source_"
"""Prefix of the module names under which a policy's files are imported."""
_END = object()
"""Marks the end of an iterator."""


def split_factory(factory: str) -> tuple[str, str]:
    """Split ``WHERE:FUNCTION``; raises SourceError when it is not of that form."""
    where, _, function = factory.rpartition(":")
    if not where or not function.isidentifier():
        raise _no_function(factory)
    return where, function


def _no_function(named: str) -> SourceError:
    if named.endswith((".onnx", ".pt", ".pt2", ".pth", ".ts")):
        fix = "put the file there (the path begins at the policy.yaml), or correct 'source'"
        return SourceError(f"'{named}' is neither a Python function nor a file that is there.", fix)
    if named.endswith(".py"):
        return SourceError(f"'{named}' names a file but no function in it.", f"add the function: {named}:NAME")
    return SourceError(f"'{named}' names no factory.", "write path/to/policy.py:make or package.module:make")


def factory_file(factory: str, folder: Path) -> Path | None:
    """Return the Python file of ``path.py:make`` (relative to ``folder``), None for ``package.module:make``."""
    where, _ = split_factory(factory)
    return (folder / where).resolve() if where.endswith(".py") else None


def import_factory(factory: str, folder: Path) -> Callable[..., Any]:
    """Import the factory function.

    Args:
        factory: ``path.py:make`` (relative to ``folder``) or ``package.module:make``.

    Raises:
        SourceError: when the file or the function does not exist, or the import fails.
        MissingExtra: when the import lacks a package.
    """
    where, function = split_factory(factory)
    path = factory_file(factory, folder)
    if path is not None and not path.is_file():
        raise SourceError(
            f"No such file: {path} (from '{factory}').", "check the path, and that of the policy.yaml that names it"
        )
    if path is None:
        _check_package(factory)
    ignore_bytecode(folder)
    try:
        with map_user_exceptions(f"importing '{where}'"):
            module = _import_path(path) if path is not None else importlib.import_module(where)
    except VlatoolError:
        raise
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"Importing '{where}' needs the package '{error.name}', which is not installed.",
            _install_hint(str(error.name)),
        ) from error
    except Exception as error:  # the seam: user code may raise anything while it is imported
        raise SourceError(
            f"Importing '{where}' failed: {type(error).__name__}: {message_of(error)}.", CORRECT_CODE
        ) from error
    make = getattr(module, function, None)
    if not callable(make):
        known = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        raise SourceError.unknown(f"'{where}' has no function '{function}'", function, known)
    if path is None:
        _check_own(make, factory)
    return make  # type: ignore[no-any-return]


def call_factory(factory: str, folder: Path, arguments: dict[str, Any]) -> Any:
    """Import the factory and call it; raises SourceError when the call raises."""
    make = import_factory(factory, folder)
    with _name_function(factory, folder, f"the factory '{factory}'"):
        return make(**arguments)


def iterate_function(function: str, folder: Path, arguments: dict[str, Any]) -> Iterator[Any]:
    """Import a function that yields, call it, and yield what it does.

    Args:
        function: name of the function, in the form of a factory.

    Raises:
        SourceError: when it raises, or gives nothing to go through.
    """
    make = import_factory(function, folder)
    with _name_function(function, folder, f"'{function}'"):
        product = make(**arguments)
        values = iter(product) if isinstance(product, Iterable) else None
    if values is None:
        kind = type(product).__name__
        raise SourceError(f"'{function}' gives a value of type {kind}; it must yield.", "let it yield its values")
    while True:
        with _name_function(function, folder, f"'{function}'"):
            value = next(values, _END)
        if value is _END:
            return
        yield value


@contextlib.contextmanager
def _name_function(factory: str, folder: Path, what: str) -> Iterator[None]:
    """Turn whatever a user's function raises in this block into an error that names it."""
    try:
        with _importable(factory_file(factory, folder)), map_user_exceptions(what):
            yield
    except (VlatoolError, MemoryError):
        raise
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"'{factory}' needs the package '{error.name}', which is not installed.", _install_hint(str(error.name))
        ) from error
    except Exception as error:  # the seam: user code may raise anything
        about = what[:1].upper() + what[1:]
        raise SourceError(f"{about} failed: {type(error).__name__}: {message_of(error)}.", CORRECT_CODE) from error


@contextlib.contextmanager
def map_user_exceptions(what: str) -> Iterator[None]:
    """Turn what a user's code raises beside ``Exception`` (``sys.exit``, classes of its own) into an error.

    Errors of vlatool that say what input was bad, or what package is absent, pass: its functions raise them where the
    code calls any. A verdict of vlatool's, or its exit code, is not for the code to give.

    Raises:
        SourceError: saying what was raised; Ctrl-C stays Ctrl-C.
    """
    about = what[:1].upper() + what[1:]
    try:
        yield
    except (InputError, MissingExtra, KeyboardInterrupt):
        raise
    except VlatoolError as error:
        message = message_of(error).partition("\n")[0].rstrip(".")
        raise SourceError(f"{about} raised {type(error).__name__}: {message}.", CORRECT_CODE) from error
    except Exception:
        raise
    except BaseException as error:  # the seam: user code may raise anything
        raise exit_error(about, type(error).__name__, message_of(error)) from error


def _check_package(factory: str) -> None:
    """Refuse modules of Python itself: what they hold builds no policy, but may run commands."""
    package = split_factory(factory)[0].partition(".")[0]
    if package in sys.stdlib_module_names:
        raise SourceError(
            f"'{factory}' names a function of Python's standard library, which makes neither policy nor environment.",
            "name a function in a file beside policy.yaml, or in a package that is made for it",
        )


def _check_own(make: Any, factory: str) -> None:
    """Refuse a function that the named package only imports from elsewhere; name the module that defines it."""
    package = split_factory(factory)[0].partition(".")[0]
    module = str(getattr(make, "__module__", None) or type(make).__module__)
    if module.partition(".")[0] != package:
        raise SourceError(
            f"'{factory}' is defined in '{module}', not in the package '{package}'.",
            "name a function that the package itself defines, or write one in a file beside policy.yaml",
        )


def _import_path(path: Path) -> ModuleType:
    digest = hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:16]
    name = f"{OWN_NAME}{digest}_{path.stem}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise SourceError(
            f"{path} is not a Python file.", "name a .py file, or an importable package: package.module:make"
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _importable(path):
            exec(compile(path.read_bytes(), str(path), "exec"), vars(module))
    except BaseException:
        sys.modules.pop(name, None)
        raise
    return module


@contextlib.contextmanager
def _importable(path: Path | None) -> Iterator[None]:
    """Make the files beside a file importable."""
    if path is None:
        yield
        return
    for neighbour in path.parent.glob("*.py"):
        loaded = getattr(sys.modules.get(neighbour.stem), "__file__", None)
        if loaded and Path(loaded).name == neighbour.name and Path(loaded).parent != path.parent:
            del sys.modules[neighbour.stem]  # another policy's file of the same name
    sys.path.insert(0, str(path.parent))
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(str(path.parent))


def _install_hint(package: str) -> str:
    extra = {"torch": "build", "minigrid": "sim", "gymnasium": "sim", "metaworld": "metaworld", "mujoco": "metaworld"}
    known = extra.get(package.partition(".")[0])
    return pip_install(known) if known else f"pip install {package}"
