"""What a worker on another machine does, whatever engine started it: one job after the other, in a child of its own."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import platform
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vlatool.errors import VlatoolError
from vlatool.files.limits import VARIABLE
from vlatool.files.messages import from_json, to_json
from vlatool.files.printable import file_of
from vlatool.machine.host import MAX_CPU_ISA, OLDER_MAX_CPU_ISA, architecture, versions
from vlatool.machine.instruction_sets import computed_in
from vlatool.machine.processes import SINGLE
from vlatool.machine.version import VERSION
from vlatool.runtime.engine import identities
from vlatool.user_code import trust
from vlatool.user_code.children import Apart, Killed
from vlatool.workers import Work
from vlatool.workers._shipped import Arriving, Parcel, Places

PASSED = (*SINGLE, MAX_CPU_ISA, OLDER_MAX_CPU_ISA, VARIABLE, "VLATOOL_DEBUG")
"""Variables that a worker has as the machine has them that sends the work: they change what is computed."""
MOST_SAID = 1000
"""The last lines of progress of a job that are told; a job says which episodes it begins."""
MATTERS = ("numpy", "onnxruntime", "onnxruntime-gpu", "onnxruntime-openvino", "openvino", "torch", "tensorrt")
"""Packages that may round differently in another version."""


@dataclass(frozen=True)
class Order:
    """What a worker is to do, and where it is asked for.

    Args:
        function, about, preload, last: Of the work.
        parcels: What its requests name.
        variables: Those of ``PASSED`` that are set.
        named: Whose code may run, as ``trust.named_so_far`` says it.
    """

    function: str
    about: str
    preload: tuple[str, ...]
    last: str
    parcels: tuple[Parcel, ...]
    variables: Mapping[str, str]
    named: Any

    @classmethod
    def of(cls, work: Work, parcels: Sequence[Parcel]) -> Order:
        """Return the order for some work, given in this process."""
        variables = {name: os.environ[name] for name in PASSED if name in os.environ}
        preload = tuple(work.preload)
        return cls(work.function, work.about, preload, work.last, tuple(parcels), variables, trust.named_so_far())


def this_machine() -> dict[str, str]:
    """Return what may differ between machines and change what is computed: name -> version."""
    installed = versions(MATTERS)
    about = {"vlatool": VERSION, "Python": platform.python_version(), "processor": str(architecture())}
    return {**about, "instruction set": computed_in(), **installed, **identities()}


class Seat:
    """A worker.

    Args:
        order: An ``Order`` as JSON values.
    """

    def __init__(self, order: Mapping[str, Any]) -> None:
        self._order = from_json(Order, order)
        self._arriving: Arriving | None = None
        self._refused: dict[str, Any] = {}
        self._opened = contextlib.ExitStack()
        self._child: Apart | None = None
        self._said: deque[str] = deque(maxlen=MOST_SAID)
        for name in PASSED:
            os.environ.pop(name, None)
        os.environ.update(self._order.variables)
        pairs = [(parcel.folder, str(parcel.place)) for parcel in self._order.parcels]
        self._there, self._back = Places(pairs), Places([(place, folder) for folder, place in pairs])

    def hello(self) -> dict[str, Any]:
        """Return what this machine is, and which parcels it lacks: their places in the order."""
        lacks = [number for number, parcel in enumerate(self._order.parcels) if not parcel.is_here()]
        return {"machine": this_machine(), "lacks": lacks, "process": os.getpid()}

    def take(self, number: int, block: bytes, last: bool) -> dict[str, Any]:
        """Take the next block of a parcel; return the first error that it meets."""
        if self._refused:
            return self._refused
        try:
            self._arriving = self._arriving or Arriving(self._order.parcels[number])
            self._arriving.add(block)
            if last:
                self._arriving.end()
                self._arriving = None
        except (VlatoolError, OSError, MemoryError) as error:
            if self._arriving is not None:
                self._arriving.abandon(error)
            self._refused = self._told(error)
            return self._refused
        return {"result": None}

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``answer``, what came of a request, what its code ``printed``, what was ``told``, and ``warnings``."""
        printed = io.StringIO()
        self._said.clear()
        with contextlib.redirect_stderr(printed), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                answer = {"result": self._call(self._order.function, self._there.named(request))}
            except (VlatoolError, OSError, MemoryError, KeyboardInterrupt) as error:
                self._dismiss()
                answer = self._told(error)
        told = [str(warning.message) for warning in warned if issubclass(warning.category, UserWarning)]
        return {"answer": self._back.told(answer), "printed": self._back.told(printed.getvalue()), "warnings": told,
                "told": list(self._said)}  # fmt: skip

    def close(self) -> None:
        """Let the child end well."""
        if self._child is not None and self._order.last:
            with contextlib.suppress(VlatoolError, OSError, MemoryError):
                self._call(self._order.last, {})
        self._dismiss()

    def _call(self, function: str, request: Any) -> Any:
        if self._child is None:
            trust.restore([[self._there.named(value) for value in folder] for folder in self._order.named])
            self._child = self._opened.enter_context(Apart(self._order.about, self._order.preload))
        return self._child.call(function, request, lambda what, _share: self._said.append(what))

    def _dismiss(self) -> None:
        """End the child; the next job has another one."""
        self._opened.close()
        self._child = None

    def _told(self, error: BaseException) -> dict[str, Any]:
        """Return an error as ``vlatool.user_code.children.result`` reads it; ``lost`` where another worker may try."""
        if isinstance(error, Killed | KeyboardInterrupt):
            return {"lost": getattr(error, "message", "its process was interrupted."), "fix": getattr(error, "fix", "")}
        if isinstance(error, VlatoolError):
            return {"error": type(error).__name__, "message": error.message, "fix": error.fix}
        if isinstance(error, OSError) and error.errno in errno.errorcode:
            return {"errno": error.errno, "message": str(error.strerror), "file": file_of(error) or None}
        if isinstance(error, MemoryError):
            return {"memory": True}
        return {"raised": type(error).__name__, "message": str(error), "ours": True}


def order_of(work: Work, parcels: Sequence[Parcel]) -> Any:
    """Return the order for some work as JSON values."""
    return to_json(Order.of(work, parcels))
