"""What every engine declares about itself, so that the build side names no engine.

A file in ``vlatool/runtime/engines/`` (or one that another package adds, see ``vlatool.registry``) defines one class
that opens a graph (``vlatool.runtime.program.Session``) and overrides what differs from the defaults here.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from vlatool import registry
from vlatool.errors import GraphError, MissingExtra, PluginError, pip_install, require

if TYPE_CHECKING:
    from vlatool.machine.target import Target

DEFAULT_ENGINE = "ort_cpu"
"""Runs a bundle that names no engine, and computes for stages that need float32 answers."""
INT8, BFLOAT16, FLOAT32, MOVING, QUANTIZING = "int8", "bfloat16", "float32", "moving data", "quantize-dequantize"
MOVES = frozenset({
    *("Reshape", "Transpose", "Concat", "Split", "Slice", "Gather", "Unsqueeze", "Squeeze", "Expand", "Identity"),
    *("Cast", "Convert", "Reorder", "ReorderInput", "ReorderOutput", "Pad", "Tile", "Flatten", "Shape", "ShapeOf"),
    *("ScatterND", "ScatterElements", "GatherElements", "ConstantOfShape", "StridedSlice", "Broadcast", "Copy"),
    *("MemoryInput", "MemoryOutput", "Parameter", "Result", "Input", "Output"),
})  # fmt: skip
"""Operators that compute nothing."""
QUANTIZES = frozenset(("QuantizeLinear", "DequantizeLinear", "DynamicQuantizeLinear", "FakeQuantize"))
STANDARD_LAYOUT = "qdq"
UNKNOWN = "not known: the engine does not compute the product that would show it"
"""How an engine computes integer products, where that is not measured."""
Stages = tuple[dict[str, dict[str, Any]], ...]
"""Names of stages, each with its options, as a recipe lists them."""
Node = tuple[str, str, str]
"""A node as an engine runs it: its name, its kind, and its kernel or dtypes."""


@dataclass(frozen=True)
class Int8Layout:
    """How ``quantize.static_int8`` writes int8 layers; without more, standard QuantizeLinear and DequantizeLinear.

    Args:
        integer: Products become integer operators, and what is normalised before them moves into them.
        fuses_convolutions: A convolution, its bias, its Relu and the quantization behind it are one kernel.
        symmetric: Activations into products are int8 without zero points, those into convolutions uint8; quantizers
            move up through what only moves values, and axes that a reduction drops are kept.
        convolutions: Products of many rows may be written as 1x1 convolutions.
        crashes: The engine crashes on some of these graphs where more than plain layers is quantized.
    """

    integer: bool = False
    fuses_convolutions: bool = True
    symmetric: bool = False
    convolutions: bool = False
    crashes: bool = False


@dataclass(frozen=True)
class NodeRun:
    """A node as an engine ran it, once.

    Args:
        name: The engine's name of the node.
        operator: The engine's type of it.
        provider: What ran it: an execution provider of ONNX Runtime, a device of OpenVINO.
        precision: What it computed in: ``INT8`` to ``QUANTIZING`` above, or another dtype; empty where the engine does
            not tell.
        macs: Multiply-accumulates; 0 where it multiplies no matrices, None where the engine does not tell.
    """

    name: str
    operator: str
    provider: str
    precision: str
    macs: int | None


class Profiled(Protocol):
    """A session that notes the time of its nodes."""

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array."""

    def times(self) -> list[dict[Node, float]]:
        """Return for each run: node -> microseconds."""


class Engine:
    """An inference library, as its class describes it."""

    title: ClassVar[str] = ""
    """The library's name, in words."""
    package: ClassVar[str] = ""
    """What is imported; also the name of the distribution."""
    extra: ClassVar[str] = ""
    """The extra of vlatool that installs it; empty where another package does."""
    substitutes: ClassVar[tuple[str, ...]] = ()
    """Distributions of other names that bring the same package."""
    advice: ClassVar[str] = ""
    """What ``doctor`` adds to the command that installs it."""
    computes: ClassVar[tuple[str, ...]] = ("float32",)
    """Dtypes of what is not quantized that a graph can ask for."""
    confined: ClassVar[bool] = False
    """Whether ``ONEDNN_MAX_CPU_ISA`` says what it computes in."""
    searched: ClassVar[bool] = False
    """Whether ``optimize`` looks for further plans beside its candidates where a board runs this engine."""
    sparse: ClassVar[tuple[str, ...]] = ()
    """Patterns of zeros in weights that its kernels skip, such as ``2:4``."""
    layouts: ClassVar[Mapping[str, Int8Layout]] = {}
    """Layouts of its own for int8 graphs, beside the standard one: name -> what is written."""
    int8: ClassVar[Mapping[str, Any]] = {"layout": "qdq", "activations": "int8"}
    """Options of ``quantize.static_int8`` for a graph that this engine runs."""
    remedy: ClassVar[str] = ""
    """What to do where its int8 products saturate."""
    traces: ClassVar[bool] = False
    """Whether a session that is opened with ``traced=True`` has ``node_runs()``: the nodes of its first run."""

    @classmethod
    def library(cls) -> Any:
        """Import the library; raises MissingExtra when it is not installed."""
        if not cls.extra and importlib.util.find_spec(cls.package) is None:
            raise MissingExtra(f"This needs the package '{cls.package}'.", cls.installation())
        return require(cls.package, cls.extra)

    @classmethod
    def distributions(cls) -> tuple[str, ...]:
        """Return the distributions that bring the library, any of which will do; the usual one first."""
        return (cls.package, *cls.substitutes)

    @classmethod
    def installation(cls) -> str:
        """Return the command that installs the library."""
        return pip_install(cls.extra) if cls.extra else f"pip install {(*cls.substitutes, cls.package)[0]}"

    @classmethod
    def is_installed(cls) -> bool:
        """Return whether the library is installed, without importing it."""
        with contextlib.suppress(ModuleNotFoundError):  # an import hook may raise it
            return importlib.util.find_spec(cls.package) is not None
        return False

    @classmethod
    def version(cls) -> str:
        """Return the library's release without its build, or empty where unknown; raises MissingExtra without it."""
        return str(getattr(cls.library(), "__version__", "")).partition("-")[0]

    @classmethod
    def arithmetic(cls) -> str:
        """Return how integer products are computed on this machine; not known, unless the engine measures it.

        Raises:
            MissingExtra: when the library is not installed.
        """
        cls.library()
        return UNKNOWN

    @classmethod
    def execution_providers(cls) -> list[str] | None:
        """Return what the library runs on, None where it does not tell; raises MissingExtra when it is absent."""
        cls.library()
        return None

    caches: ClassVar[bool] = False
    """Whether a session takes ``cache``, a key of what it builds from a graph, and ``shapes`` of the graph's inputs."""

    @classmethod
    def targets(cls) -> tuple[str, ...]:
        """Return what its nodes are to run on, as ``NodeRun.provider`` names it; empty where it does not tell."""
        return ()

    @classmethod
    def hardware(cls) -> tuple[str, str]:
        """Return the device that it runs on and the driver of that, in words; empty where that is not known."""
        from vlatool.machine.host import cpu_model  # a record alone needs it

        return cpu_model() or "", ""

    @classmethod
    def identity(cls) -> str:
        """Return what its answers depend on, part of cache keys and records: provider, device, driver, and versions.

        It is empty for an engine on the processor: keys and records have the instruction set that oneDNN computes in
        (``machine.instruction_sets.openvino_set``) and the versions of packages anyway.
        """
        return ""

    @classmethod
    def variants(cls, target: Target, calibrated: bool) -> dict[str, Stages]:
        """Return the plans that a search for the board, or this host, begins with: name -> stages."""
        return {}

    @classmethod
    def open_profiled(cls, path: Path, threads: int, compute: str, scratch: Path) -> Profiled:
        """Open a graph with timed nodes; raises GraphError when the engine refuses it, or cannot be profiled."""
        raise GraphError(
            f"The engine {cls.title} cannot be profiled.", "see which layers are quantized instead: vlatool explain"
        )

    @classmethod
    def node_precision(cls, node: Node) -> str:
        """Return what a node of a profile computes in: ``INT8`` to ``QUANTIZING`` above, or another dtype."""
        return FLOAT32

    @classmethod
    def slow(cls, node: Node, computed: str, product: bool, zero_points: int) -> str:
        """Return why an int8 node of a profile is not the fast kernel; nothing where it is.

        Args:
            product: Whether it is a matrix product or a convolution.
            zero_points: How many activations of its graph have a zero point other than 0.
        """
        return ""


def engine_class(name: str = "") -> Any:
    """Return the class of an engine, of the default one when empty; raises UsageError for an unknown engine."""
    return registry.load("engines", name or DEFAULT_ENGINE)


def class_for(name: str) -> type[Engine]:
    """Return the class of a board's engine; the base class for an engine that vlatool does not run."""
    return engine_class(name) if name in engine_names() else Engine


def engine_names() -> list[str]:
    """List the engines, the default one first."""
    return sorted(registry.names("engines"), key=lambda name: (name != DEFAULT_ENGINE, name))


def usable_engines() -> dict[str, type[Engine]]:
    """Return the classes of all engines, the default one first, without those of packages that cannot be imported.

    ``doctor`` names such a package; the engines beside it work.
    """
    classes: dict[str, type[Engine]] = {}
    for name in engine_names():
        with contextlib.suppress(PluginError):
            classes[name] = engine_class(name)
    return classes


def layouts() -> dict[str, tuple[Int8Layout, str]]:
    """Return the layouts of int8 graphs, the default one first: name -> what is written, and for which engine.

    The standard one, ``qdq``, is for the engine that runs it.
    """
    listed: dict[str, tuple[Int8Layout, str]] = {}
    for engine, library in usable_engines().items():
        own = {name: (layout, engine) for name, layout in library.layouts.items()}
        listed |= own if listed else {**own, STANDARD_LAYOUT: (Int8Layout(), "")}
    return listed


def computing(dtype: str) -> str:
    """Return the first engine that computes in a dtype; raises GraphError when none does."""
    for name, library in usable_engines().items():
        if dtype in library.computes:
            return name
    raise GraphError(
        f"No engine computes in {dtype}.", "install another engine: vlatool doctor lists them and what installs each"
    )


def is_installed(name: str) -> bool:
    """Return whether the library of an engine is installed; not, where another package's engine cannot be imported."""
    library = usable_engines().get(name)
    return library is not None and library.is_installed()


def identities() -> dict[str, str]:
    """Return what each installed engine that does not run on the processor alone depends on: name -> ``identity``."""
    found = {name: library.identity() for name, library in usable_engines().items() if library.is_installed()}
    return {name: identity for name, identity in found.items() if identity}
