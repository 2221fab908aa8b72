"""Which tensor goes where in the file of weights that all graphs of a bundle share."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path, PurePosixPath
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, instead, nearest
from vlatool.quantize.streamed._graph_rewrite import (
    PART_BYTES,
    Product,
    Rewriter,
    Task,
    copy_task,
    only_gathered,
    products_of,
    read_as_weight,
    weight_task,
)
from vlatool.quantize.streamed._weightless_export import Skeleton
from vlatool.quantize.streamed.graph_templates import BLOCKED_OPSET
from vlatool.quantize.streamed.options import WeightOptions
from vlatool.quantize.streamed.records import padded

Entry = tuple[Any, Task, "Product | str"]
"""What tells a tensor and its form from others, what becomes of it, and the product or initializer that it is for."""


@dataclass
class GraphPlan:
    """One graph and what becomes of its constants.

    Args:
        skeleton: The graph as it was.
        products: Those that are quantized, each with the number of its task.
        kept: Initializer -> the number of its task.
    """

    skeleton: Skeleton
    products: list[tuple[Product, int]] = field(default_factory=list)
    kept: dict[str, int] = field(default_factory=dict)


@dataclass
class WeightsPlan:
    """All tasks in the order of the file, and the graphs that use them."""

    stage: WeightOptions
    file: str
    graphs: dict[str, GraphPlan] = field(default_factory=dict)
    tasks: list[Task] = field(default_factory=list)

    def identity(self) -> list[Any]:
        """Return what the bytes of the file depend on, as JSON values."""
        return [
            [task.source.name, task.source.file.name, task.source.offset, task.kind, task.dtype]
            + [[piece.name, piece.dtype, list(piece.shape), piece.offset] for piece in task.pieces]
            for task in self.tasks
        ]

    def offsets(self) -> list[int]:
        """Return the first byte of each task in the file, and its size."""
        return [0, *accumulate(task_bytes(task) for task in self.tasks)]

    def save(self, out: Path) -> dict[str, int]:
        """Rewrite every graph and write ``graphs/NAME.onnx``: graph name -> opset."""
        import onnx_ir

        stage, offsets = self.stage, self.offsets()
        opsets = {}
        for name, graph in self.graphs.items():
            rewriter = Rewriter(graph.skeleton, PurePosixPath(self.file).name)
            folder = (out / self.file).parent
            for product, number in graph.products:
                task = self.tasks[number]
                values = rewriter.place(task, offsets[number], folder, product.weight)
                rewriter.quantize(product, task, values, stage.form, stage.accuracy_level)
            for initializer, number in graph.kept.items():
                rewriter.keep(initializer, self.tasks[number], offsets[number], folder)
            rewriter.finish()
            opsets[name] = int(rewriter.model.graph.opset_imports[""])
            onnx_ir.save(rewriter.model, str(out / f"graphs/{name}.onnx"))
        return opsets


def task_bytes(task: Task) -> int:
    """Return the bytes that a task takes in the file."""
    if task.kind != "copy" or not task.source.count:
        return padded(task.size)
    whole, rest = divmod(task.size, PART_BYTES)
    return whole * PART_BYTES + padded(rest)


def make_plan(skeletons: dict[str, Skeleton], stage: WeightOptions, bundle: Bundle, file: str) -> WeightsPlan:
    """Decide for every constant of every graph; a tensor that two graphs share is stored once.

    Raises:
        RecipeError: when a pattern matches no graph or no node, or the opset is too old for the layout.
    """
    plan = WeightsPlan(stage, file)
    known: dict[Any, int] = {}
    chosen = _chosen(
        {name: list(products_of(graph.model, graph.tensors)) for name, graph in skeletons.items()}, stage, bundle
    )
    order = dict.fromkeys([step.graph for step in bundle.manifest.program] + list(skeletons))
    for name, skeleton in ((name, skeletons[name]) for name in order if name in skeletons):
        graph = plan.graphs[name] = GraphPlan(skeleton)
        _raise_opset(name, skeleton, stage, bool(chosen[name]))
        entries = [*_quantized(name, skeleton, chosen[name], stage), *_kept(name, skeleton, chosen[name], stage)]
        if stage.method not in ("gptq", "awq"):
            entries.sort(key=lambda entry: (str(entry[1].source.file), entry[1].source.offset))
        for key, task, product in entries:
            if key not in known:
                known[key] = len(plan.tasks)
                plan.tasks.append(task)
            if isinstance(product, str):
                graph.kept[product] = known[key]
            else:
                graph.products.append((product, known[key]))
    return plan


def _quantized(graph: str, skeleton: Skeleton, products: list[Product], stage: WeightOptions) -> Iterator[Entry]:
    """Yield what becomes of the weights of products."""
    awq = stage.method == "awq"
    for product in products:
        source = skeleton.tensors[product.weight]
        task = weight_task(product, source, stage.form, stage.layout, awq)
        yield (_place(graph, source), product.output_first, product.node.name if awq else ""), task, product


def _kept(graph: str, skeleton: Skeleton, products: list[Product], stage: WeightOptions) -> Iterator[Entry]:
    """Yield what becomes of the initializers that somebody reads beside the quantized products."""
    replaced = {id(product.node) for product in products}
    for name, source in skeleton.tensors.items():
        value = skeleton.model.graph.initializers[name]
        if value.is_graph_output() or not all(read_as_weight(use, replaced) for use in value.uses()):
            half = stage.embeddings == "float16" and len(source.shape) == 2 and only_gathered(value)
            task = copy_task(name, source, half)
            yield (_place(graph, source), task.dtype), task, name


def _place(graph: str, source: Any) -> tuple[str, ...]:
    """Identify a stored tensor; one in memory belongs to its graph."""
    if source.array is not None:
        return (graph, source.name)
    return (str(source.file), str(source.offset), source.name)


def _chosen(products: dict[str, list[Product]], stage: WeightOptions, bundle: Bundle) -> dict[str, list[Product]]:
    for pattern in stage.graphs:
        if not fnmatch.filter(products, pattern):
            raise RecipeError(
                f"No graph matches '{pattern}'; {nearest(pattern, products)}.", instead(pattern, products)
            )
    graphs = {
        name for name in products if not stage.graphs or any(fnmatch.fnmatch(name, glob) for glob in stage.graphs)
    }
    names = [product.node.name for name in sorted(graphs) for product in products[name]]
    kept = stage.selected(names, bundle, ("MatMul", "Gemm"))
    return {
        name: [product for product in members if name in graphs and product.node.name in kept]
        for name, members in products.items()
    }


def _raise_opset(name: str, skeleton: Skeleton, stage: WeightOptions, quantized: bool) -> None:
    """Blocked DequantizeLinear needs opset 21; what opset 20 says of all other operators still holds there."""
    if stage.layout != "qdq" or not quantized:
        return
    imports = skeleton.model.graph.opset_imports
    if imports.get("", 0) >= BLOCKED_OPSET:
        return
    old = any(node.op_type == "GroupNormalization" for node in skeleton.model.graph)
    if imports.get("", 0) < BLOCKED_OPSET - 1 or old:
        raise RecipeError(
            f"The graph '{name}' has opset {imports.get('', 0)}; the layout qdq needs {BLOCKED_OPSET}.",
            "export it again with --opset 21, or use --layout ort",
        )
    imports[""] = BLOCKED_OPSET
