"""What the engines on ONNX Runtime share: a subclass that names other execution providers runs on other hardware."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import NDArray

from vlatool.errors import GraphError, MissingExtra, require
from vlatool.machine.engine_calls import REMEDY
from vlatool.machine.host import board, gpu_driver, gpus, os_name, versions
from vlatool.runtime import arithmetic
from vlatool.runtime.engine import Engine, Node, NodeRun, Profiled, computing
from vlatool.runtime.engines._bound_buffers import HOST, BoundBuffers, port_of
from vlatool.runtime.engines._deadlines import WATCHDOG
from vlatool.runtime.engines._device_tensors import on_host, run_bound
from vlatool.runtime.stored_types import has_float8

if TYPE_CHECKING:
    from vlatool.runtime.engines._ort_profile import OrtProfiled, Trace

CPU = "CPUExecutionProvider"
NO_CPU_FALLBACK = ("session.disable_cpu_ep_fallback", "1")
"""The option of ONNX Runtime (``onnxruntime_session_options_config_keys.h``) that refuses a graph with nodes that none
of the named providers runs; left alone it computes them on the processor without a word."""
SILENT = 4
"""Severity of a log that holds fatal errors alone: what an exception says is not printed, too."""
MAX_NODES = 3
"""Nodes that a message names."""
CUT_OFF_REWRITES = ["ReluQuantRewrite", "ClipQuantRewrite"]
Array = NDArray[Any]
Providers = tuple[tuple[str, Mapping[str, Any]], ...]
"""Execution providers of ONNX Runtime, the preferred one first, each with its options."""
ON_CPU: Providers = ((CPU, {}),)


class OnnxRuntimeSession(Engine):
    """One ONNX file open in ONNX Runtime on the execution providers of its class, with fallback to others off.

    Args:
        path: The ONNX file; external data is found beside it.
        threads: Intra-op threads; the cores that this process may use when None.
        compute: One of the dtypes in ``computes``, or empty.
        opened: What is opened instead of ``path``: the content of the file, or another name of it.
        traced: Whether ONNX Runtime notes the nodes of the first run, for ``node_runs``: in a temporary file, which is
            removed when they are read, or with the session. Later runs take no longer than those of another session.

    Raises:
        GraphError: when ONNX Runtime refuses the file, opens it on other providers, or is to compute in a dtype that
            is not in ``computes``.
        MissingExtra: when onnxruntime or a provider is not installed.
    """

    package = "onnxruntime"
    extra = "ort"
    traces = True
    providers: ClassVar[Providers] = ()
    """Where a graph runs. A node that none of them runs is an error, unless the processor's provider is the last."""
    memory: ClassVar[str] = HOST
    """Device type of the memory in which ONNX Runtime keeps the inputs and outputs of small graphs, such as ``cuda``:
    observations are copied there, and actions back."""

    def __init__(
        self,
        path: Path,
        threads: int | None = None,
        compute: str = "",
        opened: Path | bytes | None = None,
        traced: bool = False,
    ) -> None:
        ort = self.onnxruntime()
        model = path if opened is None else opened
        self._trace = trace_of(model) if traced else None
        self._node_runs: list[NodeRun] = []
        if compute not in ("", *self.computes):
            raise GraphError(
                f"ONNX Runtime on {self._hardware()} does not compute in {compute}.",
                f"use the engine {computing(compute)}",
            )
        try:
            folder = self._trace.folder if self._trace else None
            self._session = self._open(ort, model, threads, folder, self._providers_for(model))
        except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
            words, remedy = self._why_refused(ort, model, error)
            raise GraphError(f"ONNX Runtime {ort.__version__} refuses {path}: {words}", remedy) from error
        self._check_providers(path)
        self.path = path
        self.deadline: float | None = None
        self._options: Any = None
        self._run = self._session.run
        self.outputs = [node.name for node in self._session.get_outputs()]
        self.takes = {node.name: port_of(node) for node in self._session.get_inputs()}
        self.gives = {node.name: port_of(node) for node in self._session.get_outputs()}
        self._bound = BoundBuffers.of(self._session, ort, self.memory)
        self.bound = self._bound is not None
        self._stays: dict[str, bool] = {}
        self._passed: frozenset[str] = frozenset()

    @classmethod
    def onnxruntime(cls) -> Any:
        """Import ONNX Runtime, with the providers of this engine registered.

        Raises:
            MissingExtra: when onnxruntime is not installed, or has not got a provider.
        """
        ort = require("onnxruntime", "ort")
        cause, library = "", cls.provider_library() if cls._missing(ort) else None
        if library is not None:
            try:
                ort.register_execution_provider_library(cls._missing(ort)[0], str(library))
            except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
                cause = f" {library} cannot be loaded: {_first_line(error)}"
        if missing := cls._missing(ort):
            known = ", ".join(ort.get_available_providers())
            words = f"ONNX Runtime {ort.__version__} has no {', '.join(missing)} on this machine; it has {known}."
            raise MissingExtra(words + cause, cls.installation())
        return ort

    @classmethod
    def provider_library(cls) -> Path | None:
        """Return the file of a provider that is a plug-in; None where ONNX Runtime brings it itself.

        Raises:
            MissingExtra: when the package of the plug-in is not installed.
        """
        return None

    @classmethod
    def distributions(cls) -> tuple[str, ...]:
        """Return the distributions that bring the providers: for others than the processor's, not any onnxruntime."""
        return super().distributions() if cls._names() == [CPU] or not cls.substitutes else cls.substitutes

    @classmethod
    def is_installed(cls) -> bool:
        """Return whether ONNX Runtime and the providers are installed, without importing them."""
        return super().is_installed() and (cls._names() == [CPU] or bool(versions(cls.distributions())))

    @classmethod
    def execution_providers(cls) -> list[str]:
        """Return the providers of this engine that can be used.

        Raises:
            MissingExtra: when onnxruntime cannot be imported, has not got one of them, or cannot load it.
        """
        if unloaded := cls._unloaded(allowing_cpu(cls.onnxruntime(), arithmetic.model(), cls.providers)):
            raise MissingExtra(f"ONNX Runtime cannot load {', '.join(unloaded)} on this machine.", needs(unloaded))
        return cls._names()

    @classmethod
    def identity(cls) -> str:
        """Return providers with their options, versions of the packages, graphics cards and their driver.

        It is empty for the processor alone: keys and records have its instruction set and the versions anyway.
        """
        if cls._names() == [CPU]:
            return ""
        packages = versions(dict.fromkeys(("onnxruntime", *cls.distributions())))
        parts = [f"{name} {json.dumps(dict(options), sort_keys=True, default=str)}" for name, options in cls.providers]
        parts += [f"{name} {version}" for name, version in packages.items()]
        return "; ".join([*parts, *gpus(), *filter(None, [gpu_driver()])])

    @classmethod
    def open_profiled(cls, path: Path, threads: int, compute: str, scratch: Path) -> Profiled:
        """Open a graph with ONNX Runtime's trace of every node on; raises GraphError when ONNX Runtime refuses it."""
        ort = cls.onnxruntime()
        return profiling_session(ort, path, session_options(ort, threads), scratch, cls.providers)

    @classmethod
    def node_precision(cls, node: Node) -> str:
        """Return what a node computes in, by its kind and the dtype of its first input."""
        from vlatool.runtime.engines._ort_profile import precision

        return precision(node)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array.

        Raises:
            GraphError: when ONNX Runtime fails on these inputs.
            TimeoutError: when ``deadline`` (seconds of ``time.monotonic``; none when None) passes, or after ``stop``.
        """
        try:
            if self._trace is not None:
                return self._traced_run(feeds)
            if self.deadline is not None:
                return self._run_until(self.deadline, feeds)
            return self._call(feeds, self._options)
        except TimeoutError:
            raise
        except Exception as error:
            if self._options is not None and self._options.terminate:
                raise TimeoutError from None
            raise GraphError(
                f"ONNX Runtime failed in {self.path.name}: {_first_line(error)}", REMEDY.format(package="onnxruntime")
            ) from error

    def stop(self) -> None:
        """End the run in progress before its next node; it and later ones raise TimeoutError until ``resume``.

        Nothing happens before the first call of ``resume``, which gives runs the options that this needs.
        """
        if self._options is not None:
            self._options.terminate = True

    def resume(self) -> None:
        """Allow runs again, which ``stop`` can end from now on."""
        if self._options is None:
            self._options = quiet_run_options()
        self._options.terminate = False

    def leave_on_device(self, outputs: Collection[str], inputs: Collection[str]) -> None:
        """Leave outputs in this session's memory from now on, and expect inputs that others left there.

        A graph whose tensors are small copies them through its bound buffers all the same, which is faster.

        Args:
            outputs: outputs that only other sessions of this engine take.
            inputs: inputs that may be such outputs.
        """
        self._passed = frozenset(inputs)
        if self._bound is None and (outputs or inputs):
            self._stays = {name: name in outputs for name in self.outputs}

    def node_runs(self) -> list[NodeRun]:
        """Return the nodes of the first run of a session that is ``traced``, as ONNX Runtime ran them.

        There are none before that run, and where ONNX Runtime could not write them.
        """
        return self._node_runs

    def _traced_run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        trace, self._trace = self._trace, None
        try:
            return self.run(feeds)
        finally:
            if trace is not None:
                self._node_runs = trace.end(self._session)

    def _call(self, feeds: Mapping[str, Any], options: Any = None) -> Mapping[str, Any]:
        if self._stays:
            return run_bound(self._session, feeds, self._stays, self.memory, options)
        if self._passed:
            feeds = on_host(feeds, self._passed)
        if self._bound is not None and self._bound.takes(feeds):
            return self._bound.run(options)
        return dict(zip(self.outputs, self._run(self.outputs, feeds, options), strict=True))

    def _run_until(self, deadline: float, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run, and let another thread tell ONNX Runtime to stop before its next node at the deadline."""
        if deadline <= time.monotonic():
            raise TimeoutError
        options = quiet_run_options()
        try:
            with WATCHDOG.stopping(deadline, functools.partial(setattr, options, "terminate", True)):
                return self._call(feeds, options)
        except Exception:
            if options.terminate:
                raise TimeoutError from None
            raise

    @classmethod
    def _open(
        cls,
        ort: Any,
        model: Path | bytes,
        threads: int | None,
        trace: str | None = None,
        providers: Providers | None = None,
    ) -> Any:
        """Open a session, with other options where the first break the graph; the first error is reported.

        Args:
            trace: Directory in which ONNX Runtime notes each node that it runs; it does not where this is None.
            providers: Where it is opened; those of the class when None.
        """
        providers = cls.providers if providers is None else providers
        first, *others = (traced_into(trace, options) for options in cls._option_sets(ort, model, threads))
        try:
            return open_session(ort, model, first, providers)
        except Exception:
            for options in others:
                with contextlib.suppress(Exception):
                    return open_session(ort, model, options, providers)
            raise

    @staticmethod
    def _option_sets(ort: Any, model: Path | bytes, threads: int | None) -> list[Any]:
        """Return the options to try, one after the other."""
        return [session_options(ort, threads)]

    def _providers_for(self, model: Path | bytes) -> Providers:
        """Return the execution providers with the options for this graph."""
        return self.providers

    @classmethod
    def _names(cls) -> list[str]:
        return [name for name, _ in cls.providers]

    @classmethod
    def _missing(cls, ort: Any) -> list[str]:
        available = ort.get_available_providers()
        return [name for name in cls._names() if name not in available]

    @classmethod
    def targets(cls) -> tuple[str, ...]:
        """Return the names of the execution providers."""
        return tuple(cls._names())

    @classmethod
    def hardware(cls) -> tuple[str, str]:
        """Return the processor, or the graphics cards (a Jetson's board) and their driver (a Jetson's release)."""
        if cls._names() == [CPU]:
            return super().hardware()
        return ", ".join(gpus()) or board() or "", gpu_driver() or os_name() or ""

    @classmethod
    def _hardware(cls) -> str:
        return "the CPU" if cls._names() == [CPU] else ", ".join(cls._names())

    def _check_providers(self, path: Path) -> None:
        """Refuse a session on other providers: ONNX Runtime leaves out those that it cannot load.

        It always adds the processor's; where that is not named, ``NO_CPU_FALLBACK`` keeps every node off it.
        """
        wanted = self._names()
        opened = [name for name in self._session.get_providers() if name != CPU or CPU in wanted]
        if opened == wanted:
            return
        unloaded = self._unloaded(self._session)
        fix = "install onnxruntime alone: another package of it (onnxruntime-gpu) may be in its place"
        raise GraphError(
            f"{path} was opened on {', '.join(opened) or CPU}; wanted {', '.join(wanted)}.",
            needs(unloaded) if unloaded else fix,
        )

    @classmethod
    def _unloaded(cls, session: Any) -> list[str]:
        """Return the providers that a session was to be opened on and was not, the processor's aside."""
        return [name for name in cls._names() if name not in (*session.get_providers(), CPU)]

    @classmethod
    def _why_refused(cls, ort: Any, model: Path | bytes, error: Exception) -> tuple[str, str]:
        """Return why ONNX Runtime refuses a graph, and a remedy; of nodes that only the processor runs, which."""
        if "fallback to CPU EP has been explicitly disabled" not in str(error):
            return _first_line(error), REMEDY.format(package="onnxruntime")
        try:
            session = allowing_cpu(ort, model, cls.providers)
        except Exception:
            return _first_line(error), cls._other_engine()
        if unloaded := cls._unloaded(session):
            return f"it cannot load {', '.join(unloaded)} on this machine", needs(unloaded)
        nodes = nodes_on_cpu(session)
        about = f"{cls._hardware()} does not run {', '.join(nodes)}" if nodes else _first_line(error)
        return about, cls._other_engine()

    @classmethod
    def _other_engine(cls) -> str:
        return f"{cls._hardware()} does not run every node of it: use another engine"


def needs(providers: list[str]) -> str:
    """Return the remedy where providers cannot be loaded."""
    return f"install the driver and the libraries that {', '.join(providers)} needs"


def allowing_cpu(ort: Any, model: Path | bytes, providers: Providers) -> Any:
    """Open a graph with nodes on the processor where the providers do not run them, which the session then lists."""
    options = session_options(ort, 1)
    options.log_severity_level = SILENT
    options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
    return open_session(ort, model, options, (*providers, *ON_CPU))


def nodes_on_cpu(session: Any) -> list[str]:
    """Return the first nodes of such a session that the processor runs; none before ONNX Runtime 1.24."""
    if not hasattr(session, "get_provider_graph_assignment_info"):
        return []
    graphs = [each for each in session.get_provider_graph_assignment_info() if each.ep_name == CPU]
    named = ((node.op_type, node.name) for graph in graphs for node in graph.get_nodes())
    nodes = [f"{operator} ({name})" if name else operator for operator, name in named]
    return nodes[:MAX_NODES] + ([f"{len(nodes) - MAX_NODES} more"] if len(nodes) > MAX_NODES else [])


def session_options(ort: Any, threads: int | None) -> Any:
    """Return what every session of ONNX Runtime is opened with; the cores that this process may use when None."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
    options.inter_op_num_threads = 1
    return options


def traced_into(folder: str | None, options: Any) -> Any:
    """Return options with which a session notes each node that it runs in a file of a folder; as they are for None."""
    if folder is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(Path(folder) / "trace")
    return options


def trace_of(model: Path | bytes) -> Trace:
    """Return a trace of a graph; a robot without a record does without what that needs."""
    from vlatool.runtime.engines._ort_profile import Trace

    return Trace(model)


def quiet_run_options() -> Any:
    """Return options of a run that logs nothing but fatal errors: being stopped is none."""
    options = require("onnxruntime", "ort").RunOptions()
    options.log_severity_level = SILENT
    return options


def disabled_optimizers(model: Path | bytes) -> list[str]:
    """Return the rewritings of ONNX Runtime that would make a graph compute something else than it says.

    They drop a Relu or Clip before a QuantizeLinear whose zero point is the smallest number of its type, since rounding
    to uint8 cuts off what is negative, and (seen in 1.31) take every float8 for such a type: negative values come
    through.
    """
    return CUT_OFF_REWRITES if is_true_of(has_float8, model) else []


def is_true_of(question: Callable[..., bool], *about: Any) -> bool:
    """Return what a graph is asked; a file that is none is refused when it is opened."""
    with contextlib.suppress(GraphError, OSError):
        return question(*about)
    return False


def open_session(ort: Any, model: Path | bytes, options: Any, providers: Providers = ON_CPU) -> Any:
    """Open a graph on these providers alone, without what would make it another one."""
    content = model if isinstance(model, bytes) else str(model)
    if all(name != CPU for name, _ in providers):
        options.log_severity_level = SILENT
        options.add_session_config_entry(*NO_CPU_FALLBACK)
    named = [(name, dict(settings)) for name, settings in providers]
    optimizers = {"disabled_optimizers": disabled_optimizers(model)}
    session = ort.InferenceSession(content, options, providers=named, enable_fallback=0, **optimizers)
    if getattr(session, "_model_bytes", None):
        session._model_bytes = b""  # Python's wrapper would keep the whole content for a fallback, which is off
    return session


def profiling_session(ort: Any, path: Path, options: Any, scratch: Path, providers: Providers = ON_CPU) -> OrtProfiled:
    """Open a graph with ONNX Runtime's trace of every node on; it writes files whose names begin with ``scratch``.

    Raises:
        GraphError: when ONNX Runtime refuses it.
    """
    options.enable_profiling, options.profile_file_prefix = True, str(scratch)
    try:
        from vlatool.runtime.engines._ort_profile import OrtProfiled

        return OrtProfiled(open_session(ort, path, options, providers))
    except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
        raise GraphError(
            f"ONNX Runtime cannot profile {path.name}: {str(error)[:200]}", REMEDY.format(package="onnxruntime")
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:300]
