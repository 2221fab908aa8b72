"""Layout of the file of weights that all graphs of a bundle share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path, PurePosixPath
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.quantize.streamed._graph_rewrite import (
    PART_BYTES,
    GraphRewriter,
    Product,
    Task,
    copy_task,
    find_products,
    is_lookup_table,
    is_weight_use,
    weight_task,
)
from vlatool.quantize.streamed._weightless_export import GraphTemplate
from vlatool.quantize.streamed.graph_templates import BLOCKED_OPSET
from vlatool.quantize.streamed.options import WeightOptions
from vlatool.quantize.streamed.records import round_to_page

Entry = tuple[Any, Task, "Product | str"]
"""Key of a tensor in its form, its task, and the product or initializer that uses it."""


@dataclass
class GraphPlan:
    """One graph and the tasks of its constants.

    Args:
        products: Quantized products, each with the index of its task.
        kept: Copied initializer -> index of its task.
    """

    template: GraphTemplate
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
        """Return everything that the bytes of the file depend on, as JSON values."""
        return [
            [task.source.name, task.source.file.name, task.source.offset, task.kind, task.dtype]
            + [[piece.name, piece.dtype, list(piece.shape), piece.offset] for piece in task.pieces]
            for task in self.tasks
        ]

    def offsets(self) -> list[int]:
        """Return the first byte of each task in the file, and the size of the file."""
        return [0, *accumulate(task_bytes(task) for task in self.tasks)]

    def save(self, out: Path) -> dict[str, int]:
        """Rewrite every graph and write ``graphs/NAME.onnx``: graph name -> opset."""
        import onnx_ir

        stage, offsets = self.stage, self.offsets()
        opsets = {}
        for name, graph in self.graphs.items():
            rewriter = GraphRewriter(graph.template, PurePosixPath(self.file).name)
            folder = (out / self.file).parent
            for product, number in graph.products:
                task = self.tasks[number]
                values = rewriter.add_initializers(task, offsets[number], folder, product.weight)
                rewriter.quantize(product, task, values, stage.block_format, stage.accuracy_level)
            for initializer, number in graph.kept.items():
                rewriter.keep_initializer(initializer, self.tasks[number], offsets[number], folder)
            rewriter.finish()
            opsets[name] = int(rewriter.model.graph.opset_imports[""])
            onnx_ir.save(rewriter.model, str(out / f"graphs/{name}.onnx"))
        return opsets


def task_bytes(task: Task) -> int:
    """Return the size of a task's result in the file."""
    if task.kind != "copy" or not task.source.count:
        return round_to_page(task.size)
    whole, rest = divmod(task.size, PART_BYTES)
    return whole * PART_BYTES + round_to_page(rest)


def make_plan(templates: dict[str, GraphTemplate], stage: WeightOptions, bundle: Bundle, file: str) -> WeightsPlan:
    """Plan the conversion of every constant of every graph; a tensor that graphs share is stored once.

    Raises:
        RecipeError: when a pattern matches no graph or no node, or the opset is too old for the layout.
    """
    plan = WeightsPlan(stage, file)
    known: dict[Any, int] = {}
    selected = _selected_products(
        {name: list(find_products(graph.model, graph.tensors)) for name, graph in templates.items()}, stage, bundle
    )
    order = dict.fromkeys([step.graph for step in bundle.manifest.program] + list(templates))
    for name, template in ((name, templates[name]) for name in order if name in templates):
        graph = plan.graphs[name] = GraphPlan(template)
        _raise_opset(name, template, stage, bool(selected[name]))
        entries = [
            *_weight_entries(name, template, selected[name], stage),
            *_constant_entries(name, template, selected[name], stage),
        ]
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


def _weight_entries(
    graph: str, template: GraphTemplate, products: list[Product], stage: WeightOptions
) -> Iterator[Entry]:
    """Yield the entries of the weights of products."""
    awq = stage.method == "awq"
    for product in products:
        source = template.tensors[product.weight]
        task = weight_task(product, source, stage.block_format, stage.layout, awq)
        yield (_tensor_identity(graph, source), product.output_first, product.node.name if awq else ""), task, product


def _constant_entries(
    graph: str, template: GraphTemplate, products: list[Product], stage: WeightOptions
) -> Iterator[Entry]:
    """Yield the entries of the initializers with readers other than the quantized products."""
    replaced = {id(product.node) for product in products}
    for name, source in template.tensors.items():
        value = template.model.graph.initializers[name]
        if value.is_graph_output() or not all(is_weight_use(use, replaced) for use in value.uses()):
            half = stage.embeddings == "float16" and len(source.shape) == 2 and is_lookup_table(value)
            task = copy_task(name, source, half)
            yield (_tensor_identity(graph, source), task.dtype), task, name


def _tensor_identity(graph: str, source: Any) -> tuple[str, ...]:
    """Return the identity of a stored tensor; one in memory belongs to its graph."""
    if source.array is not None:
        return (graph, source.name)
    return (str(source.file), str(source.offset), source.name)


def _selected_products(
    products: dict[str, list[Product]], stage: WeightOptions, bundle: Bundle
) -> dict[str, list[Product]]:
    graphs = stage.matching_graphs(products)
    names = [product.node.name for name in sorted(graphs) for product in products[name]]
    selected = stage.select_nodes(names, bundle, ("MatMul", "Gemm"))
    return {
        name: [product for product in members if name in graphs and product.node.name in selected]
        for name, members in products.items()
    }


def _raise_opset(name: str, template: GraphTemplate, stage: WeightOptions, quantized: bool) -> None:
    """Raise the opset to 21 for blocked DequantizeLinear; all other operators are the same as in opset 20."""
    if stage.layout != "qdq" or not quantized:
        return
    imports = template.model.graph.opset_imports
    if imports.get("", 0) >= BLOCKED_OPSET:
        return
    old = any(node.op_type == "GroupNormalization" for node in template.model.graph)
    if imports.get("", 0) < BLOCKED_OPSET - 1 or old:
        raise RecipeError(
            f"The graph '{name}' has opset {imports.get('', 0)}; the layout qdq needs {BLOCKED_OPSET}.",
            "export it again with --opset 21, or use --layout ort",
        )
    imports[""] = BLOCKED_OPSET
