"""What every quantization method does around its own work: select nodes, walk the graphs, finish the bundle."""

from __future__ import annotations

import contextlib
import fnmatch
import io
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Graph
from vlatool.bundle.unexported import no_graph
from vlatool.data import calibration_recording, observations_for
from vlatool.errors import BundleError, RecipeError, instead, nearest
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import foreign_errors, load, part_phases, read, save
from vlatool.graph.layers import Layer, find_layers
from vlatool.graph.nodes import FOLDED, matches
from vlatool.graph.precision import FLOATS
from vlatool.quantize.calibration.non_finite import finite_layers
from vlatool.runtime.arithmetic import EXACT
from vlatool.runtime.engine import UNKNOWN
from vlatool.stage.base import Context, Transform, source_of
from vlatool.stage.counted import counted_shares
from vlatool.stage.finish import HELD, carry_over, finish, history
from vlatool.stage.products import products_apart

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

Reduced = TypeVar("Reduced", bound="Quantization")
QuantizeGraph = Callable[[str, Path, Path], str | None]
"""Graph name, original file, new file -> dtype of what is not quantized (float32 when None)."""
QUANTIZED_OPS = ("MatMul", "Gemm", "Conv")
RECURRENT = ("GRU", "LSTM", "RNN")
"""Operators that are several products and gates at once; those with int8 products are written in other ones."""
TRAINED = "quantize.qat"
"""Stage after which the command line quantizes at once."""
REDUCE_RANGE = (
    "weights of which no pair saturates, for x86 processors without VNNI: exact at full speed there, with steps up to "
    "1.4 times as large; without this option and its opposite, the board of --profile decides, or else this host"
)
REDUCED = (
    "weights: no pair of products saturates on processors without VNNI (--no-reduce-range: all 8 bits, which are "
    "slower there in ONNX Runtime and wrong in OpenVINO)"
)


class Quantization(Transform):
    """Options that every quantization method has."""

    runs_graphs: ClassVar[bool] = True
    include: tuple[str, ...] = Field((), description="globs of node names to quantize; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of node names to leave in float32")
    parts: tuple[str, ...] = Field(
        (), description="parts of the policy to quantize, as policy.yaml names them; all when empty"
    )
    graphs: tuple[str, ...] = Field((), description="globs of graph names to quantize; all when empty")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """There is a graph to quantize, every pattern for graphs matches one, and none of them is quantized already."""
        if source is None:
            return
        if not source.manifest.graphs:
            raise no_graph(source, "quantize")
        for pattern in self.graphs:
            if not fnmatch.filter(source.manifest.graphs, pattern):
                raise RecipeError(
                    f"No graph matches '{pattern}'; {nearest(pattern, source.manifest.graphs)}.",
                    instead(pattern, source.manifest.graphs),
                )
        for name in self.chosen_graphs(source):
            graph = source.manifest.graphs[name]
            quantized = [kind.replace(" weights", " (weights)") for kind in graph.precision if kind not in FLOATS]
            lower = quantized or [graph.compute]
            if lower != ["float32"] and lower != [""]:
                trained = any(entry.get("stage") == TRAINED for entry in history(source))
                again = "quantize the float32 bundle that this one was made from, or leave the graph out with --graphs"
                raise BundleError(
                    f"The graph '{name}' of {source.path} is {' and '.join(lower)} already; {self.name()} starts from "
                    "float32.",
                    "quantize qat has quantized it: this bundle is its result" if trained else again,
                )

    def transform(
        self,
        source: Bundle | None,
        out: Path,
        context: Context,
        quantize: QuantizeGraph,
        engine: str = "",
        made_by: dict[str, Any] | None = None,
    ) -> Bundle:
        """Run ``quantize(graph name, original file, new file)`` on each selected graph and finish the bundle.

        A graph that shall compute in bfloat16 leaves its phases (see ``_phase``) to a float32 graph of its own.
        """
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        (out / "graphs").mkdir()
        graphs: dict[str, Graph] = {}
        program = bundle.manifest.program
        for number, (name, graph) in enumerate(bundle.manifest.graphs.items()):
            context.tell(f"quantizing {name}", number / len(bundle.manifest.graphs))
            original, target = bundle.file(graph.file), out / graph.file
            selected = name in self.chosen_graphs(bundle)
            compute: str | None = None
            with foreign_errors(name):
                if selected:
                    compute = quantize(name, original, target)
                else:
                    save(load(original), target)
                if compute == "bfloat16":
                    program, parted = part_phases(program, name, target)
                    graphs.update({key: replace(part, opset=graph.opset) for key, part in parted.items()})
                shares = counted_shares(target, context)
            if compute:
                shares = {compute if key == "float32" else key: share for key, share in shares.items()}
            graphs[name] = Graph(graph.file, shares, graph.opset, compute or "")
        carry_over(bundle, out)
        context.tell("running the quantized graphs", None)
        observations = self.golden(bundle)
        changes = {"program": program, "engine": engine or bundle.manifest.engine}
        made_by = made_by or self.made_by()
        return finish(
            bundle, out, made_by=made_by, graphs=graphs, observations=observations, changes=changes,
            recorded=self.is_recorded(bundle),
        )  # fmt: skip

    @property
    def recording(self) -> Path | None:
        """The recording that golden observations come from; the bundle's own when None."""
        return getattr(self, "calibration", None)

    def golden(self, bundle: Bundle) -> list[dict[str, Any]]:
        """Return observations, the first of which become golden; on all of them the new bundle is held against it.

        They are those that the stage was given, where it takes any: drawn ones, of which ids are zero, do not show all
        that engines do wrong.
        """
        return observations_for(bundle, HELD, self.recording)

    def is_recorded(self, bundle: Bundle) -> bool:
        """Say whether golden observations were recorded, not drawn."""
        return calibration_recording(bundle, self.recording) is not None

    def chosen_graphs(self, bundle: Bundle) -> list[str]:
        """Return the names of the graphs that are quantized."""
        names = bundle.manifest.graphs
        return [name for name in names if not self.graphs or any(fnmatch.fnmatch(name, glob) for glob in self.graphs)]

    def layers_of(self, bundle: Bundle, ops: Iterable[str], **kinds: bool) -> dict[str, list[Layer]]:
        """Return graph -> the selected layers; ``ops`` and ``kinds`` are those of ``find_layers``."""
        layers = {}
        for name in self.chosen_graphs(bundle):
            with foreign_errors(name):
                layers[name] = find_layers(read(bundle.file(bundle.manifest.graphs[name].file)), ops, **kinds)
        selected = self.selected([layer.name for graph in layers.values() for layer in graph], bundle, tuple(ops))
        chosen = {name: [layer for layer in graph if layer.name in selected] for name, graph in layers.items()}
        finite = finite_layers(bundle, chosen)
        if not any(finite.values()):
            raise RecipeError(
                f"Every layer of {bundle.path} that was chosen reads NaN or infinity, which an input of it takes.",
                "choose others with --include, or quantize the weights alone: vlatool quantize weight-only",
            )
        return finite

    def selected(self, names: Iterable[str], bundle: Bundle, ops: Sequence[str] = QUANTIZED_OPS) -> set[str]:
        """Return which of those nodes are quantized, by include, exclude and parts.

        A pattern is held against the whole name (``blocks.0.mlp.fc1/MatMul``), the module's (``blocks.0.mlp.fc1``) and
        that of a module that was folded into it.

        Raises:
            RecipeError: when a pattern matches no node, or a part is unknown, so that a typing error does not pass in
                silence; when no node is left.
        """
        candidates = list(names)
        if not candidates:
            raise RecipeError(
                f"No layer of {bundle.path} can be quantized by {self.name()}: it takes {', '.join(ops)} with a "
                "float32 weight.",
                "look at --ops and --graphs, and at the precision of the graphs: vlatool inspect BUNDLE",
            )
        folded = _folded(bundle) if self.include or self.exclude or self.parts else {}

        def meets(name: str, patterns: tuple[str, ...]) -> bool:
            return matches(name, patterns) or (name in folded and matches(folded[name], patterns))

        for pattern in (*self.include, *self.exclude):
            if not any(meets(name, (pattern,)) for name in candidates):
                raise RecipeError(
                    f"No node matches '{pattern}'; {nearest(pattern, candidates[:200])}.",
                    instead(pattern, candidates[:200]),
                )
        parts = bundle.manifest.parts
        for part in self.parts:
            if part not in parts:
                raise RecipeError(f"The policy has no part '{part}'; {nearest(part, parts)}.", instead(part, parts))
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
            raise RecipeError(
                f"The operator '{name}' cannot be quantized; {nearest(name, QUANTIZED_OPS)}.",
                instead(name, QUANTIZED_OPS),
            )


def left_whole(name: str, model: Any) -> list[str]:
    """Say which recurrent layers of a graph keep their products in float32; nothing where there are none.

    Args:
        name: Of the graph.
        model: An ``onnx.ModelProto``.
    """
    layers = [node.name for node in model.graph.node if node.op_type in RECURRENT]
    if not layers:
        return []
    return [
        f"{name}: {', '.join(layers)} computed in float32: a recurrent layer is one operator of ONNX, whose products "
        "cannot be quantized; those of cells can (nn.GRUCell, nn.LSTMCell)"
    ]


def reduced_on_this_host(stage: Reduced, engine: str) -> Reduced:
    """Return a stage with ``reduce_range`` where int8 products saturate on this host, unless the option was given.

    Args:
        stage: Has the option.
        engine: What will run the bundle; the default engine when empty.
    """
    if "reduce_range" in stage.model_fields_set or products_apart(engine) in (EXACT, UNKNOWN):
        return stage
    return stage.model_copy(update={"reduce_range": True})


@contextlib.contextmanager
def quiet_quantizer() -> Iterator[Path]:
    """Yield a scratch directory; keep the quantizer's prints, log lines and warnings away from the user."""
    logger = logging.getLogger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with (
            scratch_directory() as scratch,
            contextlib.redirect_stdout(io.StringIO()),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            yield scratch
    finally:
        logger.setLevel(level)


def _folded(bundle: Bundle) -> dict[str, str]:
    """Return node -> ``MODULE/TYPE`` of the module that was folded into it when the policy was exported."""
    modules = {}
    for name, graph in bundle.manifest.graphs.items():
        with foreign_errors(name):
            for node in read(bundle.file(graph.file), weights=False).graph.node:
                for note in node.metadata_props:
                    if note.key == FOLDED:
                        modules[node.name] = f"{note.value}/{node.op_type}"
    return modules
