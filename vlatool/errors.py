"""The hierarchy of errors: what is wrong, how to fix it, and the exit code.

VlatoolError                 70  our bug, unless a subclass says otherwise
├── UsageError                2  an invalid command line or call
├── InputError                3  an input is bad
│   ├── BundleError              a bundle directory: missing, corrupt, incomplete, too new
│   ├── SpecError                a policy spec: names, shapes, dtypes, statistics
│   ├── SourceError              a policy source: factory, weights, ONNX file
│   ├── DataError                calibration / evaluation data or an observation
│   ├── GraphError               a graph that an engine refuses, or that computes wrong values
│   │   ├── DeadlineMissed          an inference did not end by its deadline
│   │   └── AnomalyAlarm            what a policy sees or does is unusual
│   ├── ProfileError             a hardware profile
│   ├── RecipeError              a recipe or stage options
│   ├── OutputError              the output: exists already, read-only, disk full
│   ├── TargetError              the machine to run on: unreachable, or the run ends early
│   ├── DeploymentError          a store of deployed bundles: unreadable, busy, an older release
│   ├── ServingError             a server of a policy: cannot start, be reached, or take a request
│   ├── BusError                 a bus of a robot: cannot be reached, another type, a malformed message
│   ├── SignatureError           a signature of a bundle: missing, damaged, of another key
│   ├── InstallationError        two distributions of vlatool in one environment
│   └── PluginError              another package that adds something to vlatool
├── MissingExtra              4  an optional dependency is missing; names the extra
├── GateFailed                1  measured, and outside the limits
├── Inconclusive              5  measured, and the samples cannot decide
└── FallsShort                5  the best possible result is clearly below what was requested
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import ClassVar

PACKAGE = Path(__file__).parent
DISTRIBUTION = "vlatool" if (PACKAGE / "cli").is_dir() else "vlatool-runtime"
"""Name of this distribution for pip: all of vlatool, or the part that a robot needs, without a command line."""


class VlatoolError(Exception):
    """Base of every error that vlatool raises on purpose.

    Args:
        message: problem, with what was received and what is allowed, in one or two sentences.
        fix: what the user can do next; the remedy of the class when empty.
    """

    exit_code = 70
    remedy: ClassVar[str] = ""
    """Fix for errors of this class without a fix of their own; empty if each has its own."""

    def __init__(self, message: str, fix: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.fix = fix or self.remedy

    def __str__(self) -> str:
        return f"{self.message}\n  fix: {self.fix}" if self.fix else self.message

    @classmethod
    def unknown(cls, problem: str, name: str, known: Iterable[str]) -> VlatoolError:
        """Return the error for an unknown name: the message lists the known names, the fix is the most similar one.

        Args:
            problem: what is wrong, without the full stop.
        """
        names = list(known)
        return cls(f"{problem}; {suggest(name, names)}.", fix_for(name, names))

    def __reduce__(self) -> tuple[type[VlatoolError], tuple[str, str]]:
        """Pickle message and fix, so that an error passes between processes unchanged."""
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
    """A policy spec has an impossible value, or statistics do not fit it."""

    remedy = "correct it in policy.yaml; where a bundle says it, make the bundle again"


class SourceError(InputError):
    """A policy source cannot be found, imported, built or run."""


class DataError(InputError):
    """Calibration data, evaluation data or an observation does not fit the spec."""


class GraphError(InputError):
    """A graph that an engine refuses, or that does not compute what it should."""


class DeadlineMissed(GraphError):
    """An inference did not end by its deadline; its result is not used, and the policy is as it was before."""

    remedy = "act without it: the last action again, a fallback or a stop; the policy may infer at the next step"


class AnomalyAlarm(GraphError):
    """A monitor finds what a policy sees or does unusual, and was asked to stop the robot for it."""

    remedy = "let the robot stop, and look at what the monitor watches; the policy may act again when the alarm is over"


class ProfileError(InputError):
    """A hardware profile is unknown or malformed."""


class RecipeError(InputError):
    """A recipe or the options of a stage are wrong."""


class OutputError(InputError):
    """The output exists already, is read-only, or its disk is full."""


class TargetError(InputError):
    """The machine to run on cannot be reached or used, or the run there ends early."""


class DeploymentError(InputError):
    """A store of deployed bundles is unreadable or busy, or what is asked of it would undo a newer release."""


class ServingError(InputError):
    """A server of a policy cannot start or be reached, or does not take a request."""


class BusError(InputError):
    """A bus of a robot cannot be reached, carries another type, or sends a malformed message."""


class SignatureError(InputError):
    """The signature of a bundle, or a key, is missing, damaged, or not the one that is trusted."""


class InstallationError(InputError):
    """Two distributions of vlatool, which share files, are installed in one environment."""


class PluginError(InputError):
    """Another package that extends vlatool cannot be imported, or fails."""


class MissingExtra(VlatoolError):
    """An optional dependency is missing."""

    exit_code = 4


class GateFailed(VlatoolError):
    """The measurement is outside the requested limits."""

    exit_code = 1


class Inconclusive(VlatoolError):
    """The measurement cannot decide; more samples would."""

    exit_code = 5


class FallsShort(VlatoolError):
    """The best possible result is clearly below what was requested."""

    exit_code = 5


NOT_POSSIBLE = (InputError, MissingExtra, Inconclusive, FallsShort)
"""Errors that rule out one candidate; a search continues with the others."""


def suggest(name: str, known: Iterable[str]) -> str:
    """Return a phrase that lists the known names, after the most similar one.

    Example:
        >>> suggest("rasberry-pi-5", ["raspberry-pi-5", "jetson-orin-nano"])
        "did you mean 'raspberry-pi-5'? known: jetson-orin-nano, raspberry-pi-5"
    """
    names = sorted(known)
    hit = _closest(name, names)
    listing = "known: " + (", ".join(names) if names else "none")
    return f"did you mean '{hit}'? {listing}" if hit else listing


def fix_for(name: str, known: Iterable[str]) -> str:
    """Return the fix for an unknown name, to go with a message that uses ``suggest``.

    Example:
        >>> fix_for("rasberry-pi-5", ["raspberry-pi-5", "jetson-orin-nano"])
        "write 'raspberry-pi-5'"
    """
    names = sorted(known)
    if hit := _closest(name, names):
        return f"write '{hit}'"
    if len(names) == 1:
        return f"write '{names[0]}'"
    return "choose one of those that are known" if names else "leave it out: there is nothing to choose from"


def _closest(name: str, names: list[str]) -> str:
    """Return the most similar name; empty if none is similar."""
    import difflib  # a robot that makes no mistake does without

    return next(iter(difflib.get_close_matches(name, names, n=1)), "")


def pip_install(extra: str, distribution: str = DISTRIBUTION) -> str:
    """Return the command that installs an extra of vlatool.

    Example:
        >>> pip_install("ort")
        "pip install 'vlatool[ort]'"
    """
    return f"pip install '{distribution}[{extra}]'"


def refuse_two_distributions(packages: Path = PACKAGE.parent) -> None:
    """Refuse to run if both vlatool and vlatool-runtime are installed, because they share files.

    Args:
        packages: folder that vlatool is installed in.

    Raises:
        InstallationError: when both are installed.
    """
    if all(any(packages.glob(f"{name}-*.dist-info")) for name in ("vlatool", "vlatool_runtime")):
        raise InstallationError(
            f"Both vlatool and vlatool-runtime are installed in {packages}; either has files of the other.",
            "pip uninstall -y vlatool vlatool-runtime, then pip install vlatool-runtime on a robot, vlatool elsewhere",
        )


def require_present(module: str, extra: str) -> None:
    """Raise MissingExtra, which names the extra, when a module is not installed; nothing is imported."""
    try:
        absent = module not in sys.modules and importlib.util.find_spec(module) is None
    except ImportError:
        absent = True
    if absent or sys.modules.get(module, ...) is None:
        raise _missing(module, extra)


def require(module: str, extra: str) -> ModuleType:
    """Import a module.

    Raises:
        MissingExtra: when its package is not installed, which names the extra that provides it, or cannot be imported
            although it is installed, which says why.
    """
    try:
        return importlib.import_module(module)
    except (MemoryError, VlatoolError):
        raise
    except Exception as error:  # besides ImportError, what a library of another version raises when it is imported
        top, absent = module.partition(".")[0], error.name if isinstance(error, ModuleNotFoundError) else None
        if absent is not None and absent.partition(".")[0] == top:
            raise _missing(top, extra) from error
        if absent is not None:
            raise MissingExtra(
                f"'{module}' is installed, but '{absent}', which it needs, is not.", pip_install(extra)
            ) from error
        lines = str(error).strip().splitlines() or [type(error).__name__]
        why = lines[0] if len(lines) == 1 else f"{lines[0]} ... {lines[-1]}"
        raise MissingExtra(
            f"'{top}' is installed, but cannot be imported: {why}",
            f"read what it says; where its files are damaged: pip install --force-reinstall {top}",
        ) from error


def _missing(package: str, extra: str) -> MissingExtra:
    return MissingExtra(f"This needs the package '{package}', which the extra '{extra}' provides.", pip_install(extra))
