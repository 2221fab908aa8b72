"""Which tensor goes where in the file of weights that all graphs of a bundle share."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, nearest
from vlatool.quantize._fake_export import Skeleton
from vlatool.quantize._records import padded
from vlatool.quantize._rewrite import (
    PART_BYTES,
    Layer,
    Rewriter,
    Task,
    block_task,
    copy_task,
    layers_of,
    only_gathered,
    qdq_task,
    read_as_weight,
)
from vlatool.quantize._skeletons import BLOCKED_OPSET
from vlatool.quantize._weight_options import WeightOptions


@dataclass
class GraphPlan:
    """One graph and what becomes of its constants.

    Args:
        skeleton: The graph as it was.
        layers: Those that are quantized, each with the number of its task.
        kept: Initializer -> the number of its task.
    """

    skeleton: Skeleton
    layers: list[tuple[Layer, int]] = field(default_factory=list)
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
        """Return the first byte of each task in the file."""
        found, offset = [], 0
        for task in self.tasks:
            found.append(offset)
            offset += task_bytes(task)
        return found

    def save(self, out: Path) -> dict[str, int]:
        """Rewrite every graph and write ``graphs/NAME.onnx``: graph name -> opset."""
        import onnx_ir

        stage, offsets = self.stage, self.offsets()
        opsets = {}
        for name, graph in self.graphs.items():
            rewriter = Rewriter(graph.skeleton, PurePosixPath(self.file).name)
            folder = (out / self.file).parent
            for layer, number in graph.layers:
                task = self.tasks[number]
                values = rewriter.place(task, offsets[number], folder, layer.weight)
                if stage.layout == "ort":
                    rewriter.use_blocks(layer, values, stage.form, stage.accuracy_level, task.scaled)
                else:
                    rewriter.use_qdq(layer, values, stage.form, task.scaled)
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
    layers = {name: list(layers_of(each.model, each.tensors)) for name, each in skeletons.items()}
    chosen = _chosen(layers, stage, bundle)
    order = list(dict.fromkeys([step.graph for step in bundle.manifest.program] + list(skeletons)))
    for name, skeleton in ((name, skeletons[name]) for name in order if name in skeletons):
        graph = plan.graphs[name] = GraphPlan(skeleton)
        _raise_opset(name, skeleton, stage, bool(chosen[name]))
        wanted: list[tuple[Any, Task, Layer | None, str]] = []
        for layer in chosen[name]:
            source = skeleton.tensors[layer.weight]
            make = block_task if stage.layout == "ort" else qdq_task
            task = make(layer, source, stage.form, stage.method == "awq")
            key = (_place(name, source), layer.output_first, layer.node.name if stage.method == "awq" else "")
            wanted.append((key, task, layer, ""))
        for initializer in _kept(skeleton, chosen[name]):
            source = skeleton.tensors[initializer]
            value = skeleton.model.graph.initializers[initializer]
            half = stage.embeddings == "float16" and len(source.shape) == 2 and only_gathered(value)
            task = copy_task(initializer, source, half)
            wanted.append(((_place(name, source), task.dtype), task, None, initializer))
        if stage.method not in ("gptq", "awq"):
            wanted.sort(key=lambda each: (str(each[1].source.file), each[1].source.offset))
        for key, task, quantized, initializer in wanted:
            if key not in known:
                known[key] = len(plan.tasks)
                plan.tasks.append(task)
            if quantized is not None:
                graph.layers.append((quantized, known[key]))
            else:
                graph.kept[initializer] = known[key]
    return plan


def _place(graph: str, source: Any) -> tuple[str, ...]:
    """Identify a stored tensor; one in memory belongs to its graph."""
    if source.array is not None:
        return (graph, source.name)
    return (str(source.file), str(source.offset), source.name)


def _chosen(layers: dict[str, list[Layer]], stage: WeightOptions, bundle: Bundle) -> dict[str, list[Layer]]:
    for pattern in stage.graphs:
        if not fnmatch.filter(layers, pattern):
            raise RecipeError(f"No graph matches '{pattern}'; {nearest(pattern, layers)}.")
    wanted = {name for name in layers if not stage.graphs or any(fnmatch.fnmatch(name, glob) for glob in stage.graphs)}
    kept = stage.selected([layer.node.name for name in sorted(wanted) for layer in layers[name]], bundle)
    return {
        name: [layer for layer in found if name in wanted and layer.node.name in kept] for name, found in layers.items()
    }


def _kept(skeleton: Skeleton, layers: list[Layer]) -> list[str]:
    """Return the initializers that somebody reads beside the quantized layers."""
    replaced = {id(layer.node) for layer in layers}
    kept = []
    for name in skeleton.tensors:
        value = skeleton.model.graph.initializers[name]
        if value.is_graph_output() or not all(read_as_weight(use, replaced) for use in value.uses()):
            kept.append(name)
    return kept


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
