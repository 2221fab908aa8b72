"""Base of every quantization method: selects nodes, iterates over the graphs, finishes the bundle."""

from __future__ import annotations

import contextlib
import fnmatch
import io
import logging
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Graph
from vlatool.bundle.module_bundle import no_graph_error
from vlatool.data import NamedRecording, calibration_recording, named_recording, observations_for
from vlatool.errors import BundleError, RecipeError
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import foreign_errors, load, read, save, split_phases
from vlatool.graph.layers import Layer, find_layers
from vlatool.graph.nodes import FOLDED_MODULE_KEY, matches
from vlatool.graph.precision import FLOATS
from vlatool.quantize.calibration.non_finite import finite_layers
from vlatool.runtime.arithmetic import EXACT
from vlatool.runtime.engine import UNKNOWN
from vlatool.stage.base import Context, Result, Transform
from vlatool.stage.finish import MAX_COMPARED, carry_over, finish, history
from vlatool.stage.precision_shares import count_shares
from vlatool.stage.products import int8_arithmetic
from vlatool.stage.record import SampleSet, made_by

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

StageT = TypeVar("StageT", bound="Quantization")
QuantizeGraph = Callable[[str, Path, Path], str | None]
"""Graph name, original file, new file -> dtype of the rest that is not quantized (float32 when None)."""
QUANTIZED_OPS = ("MatMul", "Gemm", "Conv")
RECURRENT = ("GRU", "LSTM", "RNN")
"""Operators of several products and gates; their int8 counterparts consist of other operators."""
TRAINING_STAGE = "quantize.qat"
"""Training stage that the command line follows with quantization."""
REDUCE_RANGE = (
    "scale weights so that no pair of products saturates, for x86 processors without VNNI: exact at full speed there, "
    "with steps up to 1.4 times as large; by default the board of --profile decides, or else this host"
)
REDUCE_RANGE_NOTE = (
    "weights: no pair of products saturates on processors without VNNI (--no-reduce-range: all 8 bits, which are "
    "slower there in ONNX Runtime and wrong in OpenVINO)"
)


class Quantization(Transform):
    """Options shared by every quantization method."""

    include: tuple[str, ...] = Field((), description="globs of node names to quantize; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of node names to leave in float32")
    parts: tuple[str, ...] = Field(
        (), description="parts of the policy to quantize, as policy.yaml names them; all when empty"
    )
    graphs: tuple[str, ...] = Field((), description="globs of graph names to quantize; all when empty")

    def inputs(self) -> tuple[Path, ...]:
        """The recording that the method calibrates on, where one is given."""
        calibration: Path | None = getattr(self, "calibration", None)
        return (calibration,) if calibration else ()

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that every graph pattern matches a graph, and that no selected graph is quantized already."""
        if source is None:
            return
        if not source.manifest.graphs:
            raise no_graph_error(source, "quantize")
        for name in self.matching_graphs(source.manifest.graphs):
            graph = source.manifest.graphs[name]
            quantized = [kind.replace(" weights", " (weights)") for kind in graph.precision if kind not in FLOATS]
            precisions = quantized or [graph.compute]
            if precisions != ["float32"] and precisions != [""]:
                trained = any(entry.get("stage") == TRAINING_STAGE for entry in history(source))
                fix = "quantize the float32 bundle that this one was made from, or exclude the graph with --graphs"
                raise BundleError(
                    f"The graph '{name}' of {source.path} is {' and '.join(precisions)} already; "
                    f"{self.name()} starts from float32.",
                    "quantize qat has quantized it: this bundle is its result" if trained else fix,
                )

    def transform(
        self,
        source: Bundle,
        out: Path,
        context: Context,
        quantize: QuantizeGraph,
        engine: str = "",
        samples: SampleSet | None = None,
        report: Mapping[str, Any] | None = None,
    ) -> Result:
        """Run ``quantize(graph name, original file, new file)`` on each selected graph and finish the bundle.

        The phases of a graph that computes in bfloat16 (``graph.phase``) move to a separate float32 graph.

        Args:
            samples: samples that the method calibrated on, for the record of the bundle.
            report: further entries of that record.
        """
        (out / "graphs").mkdir()
        graphs: dict[str, Graph] = {}
        messages: tuple[str, ...] = ()
        program = source.manifest.program
        for number, (name, graph) in enumerate(source.manifest.graphs.items()):
            context.progress(f"quantizing {name}", number / len(source.manifest.graphs))
            original, target = source.file(graph.file), out / graph.file
            selected = name in self.chosen_graphs(source)
            compute: str | None = None
            with foreign_errors(name):
                if selected:
                    compute = quantize(name, original, target)
                else:
                    save(load(original), target)
                if compute == "bfloat16":
                    program, phase_graphs = split_phases(program, name, target)
                    graphs.update({key: replace(part, opset=graph.opset) for key, part in phase_graphs.items()})
                shares, uncounted = count_shares(target)
                messages += uncounted
            if compute:
                shares = {compute if key == "float32" else key: share for key, share in shares.items()}
            graphs[name] = Graph(graph.file, shares, graph.opset, compute or "")
        carry_over(source, out)
        context.progress("running the quantized graphs", None)
        changes = {"program": program, "engine": engine or source.manifest.engine}
        recorded = {**made_by(self, calibration=samples), **(report or {})}
        made = finish(source, out, made_by=recorded, graphs=graphs, changes=changes, **self.golden_arguments(source))
        return Result(made, messages)

    @property
    def recording(self) -> NamedRecording | None:
        """Recording that ``calibration`` names; the bundle's own when None."""
        return named_recording(getattr(self, "calibration", None), getattr(self, "map", ()))

    @property
    def golden_recording(self) -> NamedRecording | None:
        """Recording of the golden observations; the bundle's own when None."""
        return self.recording

    def golden_arguments(self, source: Bundle) -> dict[str, Any]:
        """Return the observations on which ``finish`` compares the new bundle with the old one, as its arguments.

        They are taken from the stage's own recording, where it has one: synthetic observations, whose ids are zero, do
        not reveal every fault of an engine.
        """
        recording = self.golden_recording
        recorded = calibration_recording(source, recording) is not None
        return {"observations": observations_for(source, MAX_COMPARED, recording), "recorded": recorded}

    def chosen_graphs(self, bundle: Bundle) -> list[str]:
        """Return the names of the graphs to quantize."""
        return self.matching_graphs(bundle.manifest.graphs)

    def matching_graphs(self, names: Collection[str]) -> list[str]:
        """Return which of some graphs to quantize; raises RecipeError when a pattern matches none."""
        for pattern in self.graphs:
            if not fnmatch.filter(names, pattern):
                raise RecipeError.unknown(f"No graph matches '{pattern}'", pattern, names)
        return [name for name in names if not self.graphs or any(fnmatch.fnmatch(name, glob) for glob in self.graphs)]

    def selected_layers(self, bundle: Bundle, ops: Iterable[str], **kinds: bool) -> dict[str, list[Layer]]:
        """Return graph -> the selected layers; ``ops`` and ``kinds`` are those of ``find_layers``."""
        layers = {}
        for name in self.chosen_graphs(bundle):
            with foreign_errors(name):
                layers[name] = find_layers(read(bundle.file(bundle.manifest.graphs[name].file)), ops, **kinds)
        selected = self.select_nodes([layer.name for graph in layers.values() for layer in graph], bundle, tuple(ops))
        chosen = {name: [layer for layer in graph if layer.name in selected] for name, graph in layers.items()}
        finite = finite_layers(bundle, chosen)
        if not any(finite.values()):
            raise RecipeError(
                f"Every selected layer of {bundle.path} reads NaN or infinity, which one of its inputs accepts.",
                "select other layers with --include, or quantize only the weights: vlatool quantize weight-only",
            )
        return finite

    def select_nodes(self, names: Iterable[str], bundle: Bundle, ops: Sequence[str] = QUANTIZED_OPS) -> set[str]:
        """Return which of the nodes to quantize, by include, exclude and parts.

        A pattern is matched against the full name (``blocks.0.mlp.fc1/MatMul``), the name of the module
        (``blocks.0.mlp.fc1``) and that of a module that was folded into it.

        Raises:
            RecipeError: when a pattern matches no node or a part is unknown, so that a typo does not go unnoticed; when
                no node is left.
        """
        candidates = list(names)
        if not candidates:
            raise RecipeError(
                f"No layer of {bundle.path} can be quantized by {self.name()}: it takes {', '.join(ops)} with a "
                "float32 weight.",
                "look at --ops and --graphs, and at the precision of the graphs: vlatool inspect BUNDLE",
            )
        folded = _folded_modules(bundle) if self.include or self.exclude or self.parts else {}

        def meets(name: str, patterns: tuple[str, ...]) -> bool:
            return matches(name, patterns) or (name in folded and matches(folded[name], patterns))

        for pattern in (*self.include, *self.exclude):
            if not any(meets(name, (pattern,)) for name in candidates):
                raise RecipeError.unknown(f"No node matches '{pattern}'", pattern, candidates[:200])
        parts = bundle.manifest.parts
        for part in self.parts:
            if part not in parts:
                raise RecipeError.unknown(f"The policy has no part '{part}'", part, parts)
        globs = tuple(pattern for part in self.parts for pattern in parts[part])
        kept = {name for name in candidates if not self.include or meets(name, self.include)}
        if self.parts:
            kept = {name for name in kept if meets(name, globs)}
        kept = {name for name in kept if not meets(name, self.exclude)}
        if not kept:
            raise RecipeError(
                f"No layer is left to quantize: include, exclude and parts rule out all {len(candidates)}.",
                f"widen them; the first layers are {', '.join(candidates[:3])}",
            )
        return kept


def check_ops(ops: Iterable[str]) -> None:
    """Raise a user error for an operator that no method quantizes."""
    for name in ops:
        if name not in QUANTIZED_OPS:
            raise RecipeError.unknown(f"The operator '{name}' cannot be quantized", name, QUANTIZED_OPS)


def name_float_layers(result: Result, graphs: Iterable[str]) -> Result:
    """Return a result with a message on the recurrent layers of each of its graphs, whose products stay in float32."""
    found = {}
    for name in graphs:
        file = result.bundle.file(result.bundle.manifest.graphs[name].file)
        nodes = read(file, weights=False).graph.node
        found[name] = ", ".join(node.name for node in nodes if node.op_type in RECURRENT)
    messages = (
        f"{name}: {layers} computed in float32: a recurrent layer is one operator of ONNX, whose products "
        "cannot be quantized; those of cells can (nn.GRUCell, nn.LSTMCell)"
        for name, layers in found.items() if layers
    )  # fmt: skip
    return replace(result, messages=(*messages, *result.messages))


def fit_range_to_host(stage: StageT, engine: str) -> StageT:
    """Return a stage with ``reduce_range`` where int8 products saturate on this host, unless the option was given.

    Args:
        engine: Engine that will run the bundle; the default one when empty.
    """
    if "reduce_range" in stage.model_fields_set or int8_arithmetic(engine) in (EXACT, UNKNOWN):
        return stage
    return stage.unless_given({"reduce_range": True})


@contextlib.contextmanager
def silenced_quantizer() -> Iterator[Path]:
    """Yield a scratch directory; suppress the quantizer's output, log lines and warnings."""
    logger = logging.getLogger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with scratch_directory() as scratch, contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield scratch
    finally:
        logger.setLevel(level)


def _folded_modules(bundle: Bundle) -> dict[str, str]:
    """Return node -> ``MODULE/TYPE`` of the module that was folded into it when the policy was exported."""
    modules = {}
    for name, graph in bundle.manifest.graphs.items():
        with foreign_errors(name):
            for node in read(bundle.file(graph.file), weights=False).graph.node:
                for note in node.metadata_props:
                    if note.key == FOLDED_MODULE_KEY:
                        modules[node.name] = f"{note.value}/{node.op_type}"
    return modules
