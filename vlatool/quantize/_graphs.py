"""What every quantization method does around its own work: select nodes, walk the graphs, finish the bundle."""

from __future__ import annotations

import contextlib
import fnmatch
import io
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from vlatool.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import BundleError, GraphError, RecipeError, VlatoolError, nearest, require
from vlatool.finish import carry_over, finish
from vlatool.manifest import Graph
from vlatool.quantize._precision import precision_shares
from vlatool.stage import Context, Transform, source_of

if TYPE_CHECKING:
    from vlatool.profile import Profile

QuantizeGraph = Callable[[str, Path, Path], None]
QUANTIZED_OPS = ("MatMul", "Gemm", "Conv")


class Quantization(Transform):
    """Options that every quantization method has."""

    include: tuple[str, ...] = Field((), description="globs of node names to quantize; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of node names to leave in float32")
    graphs: tuple[str, ...] = Field((), description="globs of graph names to quantize; all when empty")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """There is a graph to quantize, and every pattern for graphs matches one."""
        if source is None:
            return
        if not source.manifest.graphs:
            raise BundleError(
                f"{source.path} has no graph to quantize.", "export it first: vlatool export SOURCE -o BUNDLE"
            )
        for pattern in self.graphs:
            if not fnmatch.filter(source.manifest.graphs, pattern):
                raise RecipeError(f"No graph matches '{pattern}'; {nearest(pattern, source.manifest.graphs)}.")

    def transform(self, source: Bundle | None, out: Path, context: Context, quantize: QuantizeGraph) -> Bundle:
        """Run ``quantize(graph name, original file, new file)`` on each selected graph and finish the bundle."""
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        (out / "graphs").mkdir()
        made = {}
        for number, (name, graph) in enumerate(bundle.manifest.graphs.items()):
            context.tell(f"quantizing {name}", number / len(bundle.manifest.graphs))
            original, target = bundle.file(graph.file), out / graph.file
            selected = not self.graphs or any(fnmatch.fnmatch(name, pattern) for pattern in self.graphs)
            with _foreign_errors(name):
                if selected:
                    quantize(name, original, target)
                else:
                    save(load(original), target)
                shares = precision_shares(target)
            made[name] = Graph(graph.file, shares, graph.opset)
        carry_over(bundle, out)
        context.tell("running the quantized graphs", None)
        observations = observations_for(bundle, 2)
        return finish(bundle, out, made_by=self.made_by(), graphs=made, observations=observations)

    def excluded_nodes(self, model: Any, ops: tuple[str, ...], *, attention: bool = False) -> list[str]:
        """Return the names of the nodes of those operators that must stay in float32.

        Args:
            model: An ``onnx.ModelProto``.
            ops: Operator types that are quantized at all.
            attention: Whether products of two activations are quantized too.

        Raises:
            RecipeError: when a pattern matches no node, so that a typing error does not pass in silence.
        """
        candidates = [node.name for node in model.graph.node if node.op_type in ops]
        for pattern in (*self.include, *self.exclude):
            if not fnmatch.filter(candidates, pattern):
                raise RecipeError(f"No {'/'.join(ops)} node matches '{pattern}'; {nearest(pattern, candidates[:12])}.")
        constants = {tensor.name for tensor in model.graph.initializer}
        weightless = {
            node.name
            for node in model.graph.node
            if node.op_type in ("MatMul", "Gemm") and not attention and not constants.intersection(node.input)
        }
        kept = {name for name in candidates if not self.include or _any(name, self.include)} - weightless
        return [name for name in candidates if name not in kept or _any(name, self.exclude)]


def quantization_library() -> Any:
    """Import ONNX Runtime's quantizer, which needs both onnx and onnxruntime."""
    require("onnx", "build")
    return require("onnxruntime.quantization", "ort")


def load(path: Path) -> Any:
    """Load an ONNX model with its weights, without the shapes that ONNX Runtime's quantizer trips over.

    The dynamo exporter records the shape of a Gemm's weight before a transposition that the quantizer undoes; without
    ``value_info`` the shapes are inferred afresh.
    """
    onnx = require("onnx", "build")
    model = onnx.load(str(path))
    del model.graph.value_info[:]
    return model


def save(model: Any, path: Path) -> None:
    """Write an ONNX model; weights beyond protobuf's 2 GiB go to a file beside it. Never appends to stale data."""
    onnx = require("onnx", "build")
    large = model.ByteSize() > 1_500_000_000
    data = path.with_name(path.name + ".data")
    data.unlink(missing_ok=True)
    onnx.save(model, str(path), save_as_external_data=large, location=data.name)


@contextlib.contextmanager
def quiet_quantizer() -> Iterator[Path]:
    """Yield a scratch directory; keep the quantizer's prints, log lines and warnings away from the user."""
    logger = logging.getLogger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with (
            tempfile.TemporaryDirectory(prefix="vlatool-") as scratch,
            contextlib.redirect_stdout(io.StringIO()),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            yield Path(scratch)
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def _foreign_errors(graph: str) -> Iterator[None]:
    try:
        yield
    except (VlatoolError, OSError, MemoryError):
        raise
    except Exception as error:  # the seam: onnx and ONNX Runtime raise many foreign types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise GraphError(f"The graph '{graph}' cannot be quantized: {type(error).__name__}: {reason}.") from error


def _any(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns)
