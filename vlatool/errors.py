"""The tree of user faults: what was wrong, what to do, and the exit code.

VlatoolError                 70  our bug, unless a subclass says otherwise
├── UsageError                2  an invalid command line or call
├── InputError                3  an input is bad
│   ├── BundleError              a bundle directory: missing, corrupt, half, too new
│   ├── SpecError                a policy spec: names, shapes, dtypes, statistics
│   ├── SourceError              a policy source: factory, weights, ONNX file
│   ├── DataError                calibration / evaluation data or an observation
│   ├── GraphError               a graph that an engine refuses, or that computes wrong values
│   ├── ProfileError             a hardware profile
│   ├── RecipeError              a recipe or stage options
│   ├── OutputError              the place to write to: exists, read-only, full
│   ├── TargetError              the machine that something should run on: unreachable, or it ends
│   ├── InstallationError        two distributions of vlatool in one environment
│   └── PluginError              another package that adds something to vlatool
├── MissingExtra              4  an optional dependency is absent; names the extra
├── GateFailed                1  measured, and outside the limits
├── Inconclusive              5  measured, and the samples cannot decide
└── FallsShort                5  what can be made is clearly less than what was asked for
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import ClassVar

HERE = Path(__file__).parent
DISTRIBUTION = "vlatool" if (HERE / "cli").is_dir() else "vlatool-runtime"
"""What pip calls this installation: all of vlatool, or what a robot needs alone, which has no command line."""


class VlatoolError(Exception):
    """Base of every error that vlatool raises on purpose.

    Args:
        message: What was wrong, what was got and what is allowed; one or two sentences.
        fix: What the person can do next; the remedy of the class when empty.
    """

    exit_code = 70
    remedy: ClassVar[str] = ""
    """What helps wherever an error of this class is raised; empty where that depends on the place, which says it."""

    def __init__(self, message: str, fix: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.fix = fix or self.remedy

    def __str__(self) -> str:
        return f"{self.message}\n  fix: {self.fix}" if self.fix else self.message

    def __reduce__(self) -> tuple[type[VlatoolError], tuple[str, str]]:
        """Pickle both parts, so that an error crosses a process border unchanged."""
        return type(self), (self.message, self.fix)


class UsageError(VlatoolError):
    """The command line or the call is invalid."""

    exit_code = 2


class InputError(VlatoolError):
    """An input is missing, corrupt or of the wrong kind."""

    exit_code = 3


class BundleError(InputError):
    """A bundle directory is missing, corrupt, incomplete or too new."""

    remedy = "copy the bundle again from where it was made, or make it again"


class SpecError(InputError):
    """A policy spec names something impossible, or statistics do not fit it."""

    remedy = "correct it in policy.yaml; where a bundle says it, make the bundle again"


class SourceError(InputError):
    """A policy source cannot be found, imported, built or run."""


class DataError(InputError):
    """Calibration data, evaluation data or an observation does not fit the spec."""


class GraphError(InputError):
    """A graph that an engine refuses, or that does not compute what it should."""


class ProfileError(InputError):
    """A hardware profile is unknown or malformed."""


class RecipeError(InputError):
    """A recipe or the options of a stage are wrong."""


class OutputError(InputError):
    """The place to write to exists already, is read-only or is full."""


class TargetError(InputError):
    """The machines that something should run on cannot be reached or used, or what runs there ends."""


class InstallationError(InputError):
    """Two distributions of vlatool are installed in one environment, each with files of the other."""


class PluginError(InputError):
    """Another package that adds something to vlatool cannot be imported, or fails."""


class MissingExtra(VlatoolError):
    """An optional dependency is absent."""

    exit_code = 4


class GateFailed(VlatoolError):
    """The measurement is outside the limits that were asked for."""

    exit_code = 1


class Inconclusive(VlatoolError):
    """The measurement cannot decide; more samples would."""

    exit_code = 5


class FallsShort(VlatoolError):
    """What can be made is clearly less than what was asked for."""

    exit_code = 5


NOT_MADE = (3, 4, 5)
"""Exit codes of errors that say that something cannot be made of a policy; where others are tried, these go on."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return part of a sentence that lists what is known, with the nearest name first.

    Example:
        >>> nearest("rasberry-pi-5", ["raspberry-pi-5", "jetson-orin-nano"])
        "did you mean 'raspberry-pi-5'? known: jetson-orin-nano, raspberry-pi-5"
    """
    names = sorted(known)
    hit = _near(name, names)
    listing = "known: " + (", ".join(names) if names else "none")
    return f"did you mean '{hit}'? {listing}" if hit else listing


def instead(name: str, known: Iterable[str]) -> str:
    """Return what to do about a name that is not known, beside a message with what ``nearest`` says of it.

    Example:
        >>> instead("rasberry-pi-5", ["raspberry-pi-5", "jetson-orin-nano"])
        "write 'raspberry-pi-5'"
    """
    names = sorted(known)
    if hit := _near(name, names):
        return f"write '{hit}'"
    if len(names) == 1:
        return f"write '{names[0]}'"
    return "choose one of those that are known" if names else "leave it out: there is none to choose from"


def _near(name: str, names: list[str]) -> str:
    """Return the name that is most like another one, empty where none is."""
    return next(iter(difflib.get_close_matches(name, names, n=1)), "")


def install(extra: str, distribution: str = DISTRIBUTION) -> str:
    """Return the command that installs an extra of vlatool.

    Example:
        >>> install("ort")
        "pip install 'vlatool[ort]'"
    """
    return f"pip install '{distribution}[{extra}]'"


def refuse_two_distributions(packages: Path = HERE.parent) -> None:
    """Refuse to go on where vlatool and vlatool-runtime are installed side by side: they own the same files.

    Args:
        packages: The folder that vlatool is installed in.

    Raises:
        InstallationError: when both are.
    """
    if all(any(packages.glob(f"{name}-*.dist-info")) for name in ("vlatool", "vlatool_runtime")):
        raise InstallationError(
            f"Both vlatool and vlatool-runtime are installed in {packages}; either has files of the other.",
            "pip uninstall -y vlatool vlatool-runtime, then pip install vlatool-runtime on a robot, vlatool elsewhere",
        )


def require_present(module: str, extra: str) -> None:
    """Raise for a module that is absent, without importing it; names the extra that provides it.

    Raises:
        MissingExtra: when the module is not installed.
    """
    try:
        absent = module not in sys.modules and importlib.util.find_spec(module) is None
    except ImportError:
        absent = True
    if absent or sys.modules.get(module, ...) is None:
        raise MissingExtra(f"This needs the package '{module}', which the extra '{extra}' provides.", install(extra))


def require(module: str, extra: str) -> ModuleType:
    """Import ``module``; where that fails, name the extra that provides it.

    Raises:
        MissingExtra: when the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        top = module.partition(".")[0]
        if error.name is not None and error.name.partition(".")[0] != top:
            raise MissingExtra(
                f"'{module}' is installed, but '{error.name}', which it needs, is not.",
                install(extra),
            ) from error
        raise MissingExtra(
            f"This needs the package '{top}', which the extra '{extra}' provides.",
            install(extra),
        ) from error
