"""A worker on another machine, whatever engine started it: it runs one job after the other in a child process."""

from __future__ import annotations

import contextlib
import io
import os
import platform
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vlatool.errors import VlatoolError
from vlatool.files.limits import LIMITS_VARIABLE
from vlatool.files.messages import from_json
from vlatool.machine.host import MAX_CPU_ISA, OLDER_MAX_CPU_ISA, architecture, versions
from vlatool.machine.instruction_sets import openvino_set
from vlatool.machine.processes import SINGLE
from vlatool.machine.version import VERSION
from vlatool.runtime.engine import identities
from vlatool.user_code import trust
from vlatool.user_code.children import Child, ChildKilled, error_record
from vlatool.workers import Work
from vlatool.workers._file_transfer import IncomingParcel, Parcel, PathTranslation

PASSED_VARIABLES = (*SINGLE, MAX_CPU_ISA, OLDER_MAX_CPU_ISA, LIMITS_VARIABLE, "VLATOOL_DEBUG")
"""Variables that a worker has as the machine has them that sends the work: they change what is computed."""
MAX_PROGRESS_LINES = 1000
"""The last lines of progress of a job that are told; a job says which episodes it begins."""
RELEVANT_PACKAGES = ("numpy", "onnxruntime", "onnxruntime-gpu", "onnxruntime-openvino", "openvino", "torch", "tensorrt")
"""Packages that may round differently in another version."""


@dataclass(frozen=True)
class Order:
    """What a worker is to do, and where it is asked for.

    Args:
        function, about, preload, last: fields of the work.
        parcels: what its requests name.
        variables: values of the ``PASSED_VARIABLES`` that are set.
        named: folders whose code may run, as ``trust.named_folders`` returns them.
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
        variables = {name: os.environ[name] for name in PASSED_VARIABLES if name in os.environ}
        preload = tuple(work.preload)
        return cls(work.function, work.about, preload, work.last, tuple(parcels), variables, trust.named_folders())


def this_machine() -> dict[str, str]:
    """Return what may differ between machines and change what is computed: name -> version."""
    installed = versions(RELEVANT_PACKAGES)
    about = {"vlatool": VERSION, "Python": platform.python_version(), "processor": str(architecture())}
    return {**about, "instruction set": openvino_set(), **installed, **identities()}


class RemoteWorker:
    """A worker that is given an ``Order`` as JSON values."""

    def __init__(self, order: Mapping[str, Any]) -> None:
        self._order = from_json(Order, order)
        self._arriving: IncomingParcel | None = None
        self._refused: dict[str, Any] = {}
        self._opened = contextlib.ExitStack()
        self._child: Child | None = None
        self._said: deque[str] = deque(maxlen=MAX_PROGRESS_LINES)
        for name in PASSED_VARIABLES:
            os.environ.pop(name, None)
        os.environ.update(self._order.variables)
        pairs = [(parcel.folder, str(parcel.place)) for parcel in self._order.parcels]
        self._to_local = PathTranslation(pairs)
        self._to_sender = PathTranslation([(path, folder) for folder, path in pairs])

    def hello(self) -> dict[str, Any]:
        """Return what this machine is, and which parcels it lacks: their places in the order."""
        lacks = [number for number, parcel in enumerate(self._order.parcels) if not parcel.is_here()]
        return {"machine": this_machine(), "lacks": lacks, "process": os.getpid()}

    def take(self, number: int, block: bytes, last: bool) -> dict[str, Any]:
        """Take the next block of a parcel; return the first error that it meets."""
        if self._refused:
            return self._refused
        try:
            self._arriving = self._arriving or IncomingParcel(self._order.parcels[number])
            self._arriving.add(block)
            if last:
                self._arriving.end()
                self._arriving = None
        except (VlatoolError, OSError, MemoryError) as error:
            if self._arriving is not None:
                self._arriving.abandon(error)
            self._refused = self._error_record(error)
            return self._refused
        return {"result": None}

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``answer``, what came of a request, what its code ``printed``, what was ``told``, and ``warnings``."""
        printed = io.StringIO()
        self._said.clear()
        with contextlib.redirect_stderr(printed), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                answer = {"result": self._call(self._order.function, self._to_local.translate(request))}
            except (VlatoolError, OSError, MemoryError, KeyboardInterrupt) as error:
                self._dismiss()
                answer = self._error_record(error)
        told = [str(warning.message) for warning in warned if issubclass(warning.category, UserWarning)]
        reply, output = self._to_sender.rewrite(answer), self._to_sender.rewrite(printed.getvalue())
        return {"answer": reply, "printed": output, "warnings": told, "told": list(self._said)}

    def close(self) -> None:
        """Let the child end well."""
        if self._child is not None and self._order.last:
            with contextlib.suppress(VlatoolError, OSError, MemoryError):
                self._call(self._order.last, {})
        self._dismiss()

    def _call(self, function: str, request: Any) -> Any:
        if self._child is None:
            trust.restore(self._to_local.translate(self._order.named))
            self._child = self._opened.enter_context(Child(self._order.about, self._order.preload))
        return self._child.call(function, request, lambda what, _share: self._said.append(what))

    def _dismiss(self) -> None:
        """End the child; the next job has another one."""
        self._opened.close()
        self._child = None

    def _error_record(self, error: BaseException) -> dict[str, Any]:
        """Return an error as ``vlatool.user_code.children.result`` reads it; ``lost`` where another worker may try."""
        if isinstance(error, ChildKilled | KeyboardInterrupt):
            return {"lost": getattr(error, "message", "its process was interrupted."), "fix": getattr(error, "fix", "")}
        return error_record(error) or {"raised": type(error).__name__, "message": str(error), "ours": True}
