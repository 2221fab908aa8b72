"""A torch module as an ONNX model: torch's dynamo exporter, quiet, its errors explained, nodes named by modules."""

from __future__ import annotations

import ast
import contextlib
import io
import logging
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError, require
from vlatool.graph.gemm_factors import extract_gemm_factors
from vlatool.graph.nodes import FOLDED_MODULE_KEY
from vlatool.graph.random_ops import refuse_random_ops
from vlatool.module.changed_buffers import refuse_changed_buffers
from vlatool.module.factory import map_user_exceptions
from vlatool.module.failures import export_error
from vlatool.module.norms import divide_by_roots
from vlatool.module.torchlib import shared_table

if TYPE_CHECKING:
    from torch import nn

IMPORTS = (
    "torch._dynamo", "torch.export._trace", "torch.onnx._internal.exporter._compat",
    "onnxscript.function_libs.torch_lib.ops", "vlatool.module.torchlib_preload",
)  # fmt: skip
"""What the first export of a process imports, half of its time; names that a release has no more cost that alone."""
OPSET = 20
"""Opset of the default domain, unless another one is asked for."""
NAME_SCOPES = "pkg.torch.onnx.name_scopes"
"""Where torch's exporter notes the modules that a node is from."""
EXTERNAL_DATA_BYTES = 1_500_000_000
"""Weights above this go into a file beside the graph: protobuf ends at 2 GiB."""


def exported_by_torch(module: Any, arguments: Sequence[Any], step: ProgramStep, opset: int, **options: Any) -> Any:
    """Export a module with torch's dynamo exporter; return its ``ONNXProgram``.

    Args:
        arguments: one tensor for each feed of the step, real or fake.

    Raises:
        GraphError: when torch cannot, or the graph would draw random numbers.
        SourceError: when an output depends on a buffer that the module changes.
    """
    exported = translate(module, arguments, step, opset, **options)
    refuse_changed_buffers(exported.exported_program, step.graph)
    refuse_random_ops(exported.model, step.graph)
    rewrite_for_engines(exported.model)
    return exported


def rewrite_for_engines(model: Any) -> None:
    """Write what torch's exporters give as engines recognise it, in place."""
    divide_by_roots(model)
    extract_gemm_factors(model)


def translate(module: Any, arguments: Sequence[Any], step: ProgramStep, opset: int, **options: Any) -> Any:
    """Return the ``ONNXProgram`` that torch's dynamo exporter makes, as it makes it.

    Raises:
        GraphError: when torch cannot.
    """
    torch = require("torch", "build")
    try:
        with quiet_exporter(), shared_table(), torch.no_grad(), map_user_exceptions("the policy's forward()"):
            return torch.onnx.export(
                module, tuple(arguments), dynamo=True, opset_version=opset, input_names=list(step.feeds),
                output_names=list(step.gives), verbose=False, **options,
            )  # fmt: skip
    except SourceError:
        raise
    except Exception as error:  # the seam: the exporter raises many foreign types
        raise_interrupt(error)
        raise export_error(error, step.graph, module) from error


def raise_interrupt(error: BaseException | None) -> None:
    """Raise Ctrl-C again where a library has wrapped it into an error of its own."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        seen.add(id(error))
        error = error.__cause__ or error.__context__


def name_by_module(model: Any) -> None:
    """Name every node after the torch module that it comes from, so that globs can choose layers.

    ``blocks.0.mlp.fc1/MatMul``; a second node of that type in the module is ``blocks.0.mlp.fc1/MatMul_1``. What belongs
    to no module keeps the exporter's name. A layer with a normalisation folded in comes from the module that holds its
    weights; the normalisation's is noted beside it (``FOLDED_MODULE_KEY``).
    """
    seen: Counter[str] = Counter()
    for node in model.graph.all_nodes():
        scopes = node.metadata_props.get(NAME_SCOPES, "")
        names = ast.literal_eval(scopes) if scopes.startswith("[") else []
        if len(names) < 2 or not names[-2]:
            continue
        module = _folded_into(node) or names[-2]
        if module != names[-2]:
            node.metadata_props[FOLDED_MODULE_KEY] = names[-2]
        base = f"{module}/{node.op_type}"
        node.name = base if not seen[base] else f"{base}_{seen[base]}"
        seen[base] += 1


def _folded_into(node: Any) -> str:
    """Return the module whose weights a node has that an exporter folded a BatchNorm into; nothing for others."""
    if "BatchNorm" not in node.metadata_props.get("pkg.onnxscript.rewriter.rule_name", ""):
        return ""
    weight = node.inputs[1].name if len(node.inputs) > 1 and node.inputs[1] is not None else ""
    return weight.removesuffix(".weight") if weight.endswith(".weight") else ""


def strip_notes(model: Any) -> None:
    """Remove what an exporter notes beside the graph (stack traces with file paths): it would leak and differ."""
    graphs = [model.graph, *(function.graph for function in model.functions.values())]
    model.metadata_props.clear()
    for graph in graphs:
        graph.metadata_props.clear()
        graph.doc_string = None
        values = [*graph.inputs, *graph.outputs, *graph.initializers.values()]
        for node in graph.all_nodes():
            folded = node.metadata_props.get(FOLDED_MODULE_KEY)
            node.metadata_props.clear()
            if folded:
                node.metadata_props[FOLDED_MODULE_KEY] = folded
            node.doc_string = None
            values.extend(node.outputs)
        for value in values:
            value.metadata_props.clear()
            value.doc_string = None


def weight_bytes(module: nn.Module) -> int:
    """Return the bytes of all parameters and buffers."""
    return sum(tensor.numel() * tensor.element_size() for tensor in [*module.parameters(), *module.buffers()])


@contextlib.contextmanager
def quiet_exporter() -> Iterator[None]:
    """Keep the exporter's progress prints, log lines and warnings away from the user's terminal."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    nowhere = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere), warnings.catch_warnings()
        ):  # fmt: skip
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
