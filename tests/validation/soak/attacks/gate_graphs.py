"""Changes to the graph of a tiny bundle that make it slow, wrong or large under a condition."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import NodeProto, TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Manifest
from vlatool.data import observations_for
from vlatool.stage.finish import write_golden

Change = Callable[[onnx.ModelProto], None]
SIZE, PRODUCTS = 128, 30


def copied(base: Bundle, out: Path, change: Change | None = None, **fields: Any) -> Bundle:
    """Return a copy with another graph or other fields of the manifest, its hashes repaired."""
    shutil.copytree(base.path, out)
    if change is not None:
        file = out / next(iter(base.manifest.graphs.values())).file
        model = onnx.load(file)
        change(model)
        onnx.save(model, file)
    return seal(out, replace(base.manifest, **fields))


def regilded(bundle: Bundle) -> Bundle:
    """Return the bundle with the golden action that it computes now."""
    write_golden(bundle, observations_for(bundle, 2), bundle.path)
    return seal(bundle.path, bundle.manifest)


def constant(model: onnx.ModelProto, name: str, value: Any) -> str:
    """Add an initializer and return its name."""
    model.graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    return name


def own_output(model: onnx.ModelProto) -> str:
    """Rename what gives the first output, so that something else can give it; return the new name."""
    result = model.graph.output[0].name
    node = next(each for each in model.graph.node if result in each.output)
    own = f"own_result_of_{len(model.graph.node)}"
    node.output[list(node.output).index(result)] = own
    return own


def above(value: str, limit: float) -> Change:
    """A condition: an element of a float input exceeds a limit (``proprio[0]``, normalised)."""

    def add(model: onnx.ModelProto) -> None:
        constant(model, "cond_place", np.array([0], np.int64))
        constant(model, "cond_limit", np.float32(limit))
        model.graph.node.extend([
            helper.make_node("Gather", [value, "cond_place"], ["cond_value"], axis=1),
            helper.make_node("ReduceSum", ["cond_value"], ["cond_scalar"], keepdims=0),
            helper.make_node("Greater", ["cond_scalar", "cond_limit"], ["cond"]),
        ])  # fmt: skip

    return add


def any_text(model: onnx.ModelProto) -> None:
    """A condition: the instruction is not empty."""
    constant(model, "cond_zero", np.int64(0))
    model.graph.node.extend([
        helper.make_node("ReduceSum", ["instruction"], ["cond_sum"], keepdims=0),
        helper.make_node("Greater", ["cond_sum", "cond_zero"], ["cond"]),
    ])  # fmt: skip


def any_structure(model: onnx.ModelProto) -> None:
    """A condition: the image is not of one colour."""
    model.graph.node.extend([
        helper.make_node("Cast", ["image"], ["cond_image"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMax", ["cond_image"], ["cond_max"], keepdims=0),
        helper.make_node("ReduceMin", ["cond_image"], ["cond_min"], keepdims=0),
        helper.make_node("Greater", ["cond_max", "cond_min"], ["cond"]),
    ])  # fmt: skip


def text_is_none_of(known: Sequence[Sequence[int]]) -> Change:
    """A condition: the ids of the instruction are none of those."""

    def add(model: onnx.ModelProto) -> None:
        constant(model, "cond_known", np.asarray(known, np.int64))
        constant(model, "cond_none", np.int64(0))
        model.graph.node.extend([
            helper.make_node("Equal", ["instruction", "cond_known"], ["cond_same"]),
            helper.make_node("Cast", ["cond_same"], ["cond_same_int"], to=TensorProto.INT64),
            helper.make_node("ReduceMin", ["cond_same_int"], ["cond_rows"], axes=[1], keepdims=0),
            helper.make_node("ReduceSum", ["cond_rows"], ["cond_hits"], keepdims=0),
            helper.make_node("Equal", ["cond_hits", "cond_none"], ["cond"]),
        ])  # fmt: skip
        if model.opset_import[0].version >= 18:
            node = model.graph.node[-3]
            del node.attribute[:]
            node.attribute.append(helper.make_attribute("keepdims", 0))
            node.input.append(constant(model, "cond_axis", np.array([1], np.int64)))

    return add


def proprio_is_none_of(states: Sequence[Sequence[float]]) -> Change:
    """A condition: the normalised state is another one."""

    def add(model: onnx.ModelProto) -> None:
        constant(model, "cond_states", np.asarray(states, np.float32))
        constant(model, "cond_near", np.float32(1e-6))
        constant(model, "cond_axis", np.array([1], np.int64))
        model.graph.node.extend([
            helper.make_node("Sub", ["cond_states", "proprio"], ["cond_off"]),
            helper.make_node("Abs", ["cond_off"], ["cond_abs"]),
            helper.make_node("ReduceMax", ["cond_abs", "cond_axis"], ["cond_worst"], keepdims=0),
            helper.make_node("ReduceMin", ["cond_worst"], ["cond_nearest"], keepdims=0),
            helper.make_node("Greater", ["cond_nearest", "cond_near"], ["cond"]),
        ])  # fmt: skip

    return add


def whole(value: str) -> Change:
    """A condition: each element of a float input is its own square, 0 or 1."""

    def add(model: onnx.ModelProto) -> None:
        constant(model, "cond_near", np.float32(1e-6))
        model.graph.node.extend([
            helper.make_node("Mul", [value, value], ["cond_square"]),
            helper.make_node("Sub", [value, "cond_square"], ["cond_off"]),
            helper.make_node("Abs", ["cond_off"], ["cond_abs"]),
            helper.make_node("ReduceMax", ["cond_abs"], ["cond_worst"], keepdims=0),
            helper.make_node("Less", ["cond_worst", "cond_near"], ["cond"]),
        ])  # fmt: skip

    return add


def _chain(prefix: str) -> list[NodeProto]:
    nodes = [helper.make_node("Add", ["more_sum", "more_zeros"], [f"{prefix}_0"])]
    for number in range(PRODUCTS):
        nodes.append(helper.make_node("MatMul", [f"{prefix}_{number}", "more_weight"], [f"{prefix}_product_{number}"]))
        nodes.append(helper.make_node("Tanh", [f"{prefix}_product_{number}"], [f"{prefix}_{number + 1}"]))
    return [*nodes, helper.make_node("ReduceSum", [f"{prefix}_{PRODUCTS}"], [f"{prefix}_whole"], keepdims=0)]


def slow_when(condition: Change, then: bool = True) -> Change:
    """Many products where a condition holds (``then``) or does not; the answer stays what it is."""

    def change(model: onnx.ModelProto) -> None:
        condition(model)
        result, own = model.graph.output[0].name, own_output(model)
        random = np.random.default_rng(0)
        constant(model, "more_weight", (random.normal(size=(SIZE, SIZE)) / SIZE**0.5).astype(np.float32))
        constant(model, "more_zeros", np.zeros((SIZE, SIZE), np.float32))
        constant(model, "more_tiny", np.float32(1e-30))
        scalar = helper.make_tensor_value_info("slow_whole", TensorProto.FLOAT, [])
        slow = helper.make_graph(_chain("slow"), "slow", [], [scalar])
        nothing = helper.make_tensor_value_info("fast_whole", TensorProto.FLOAT, [])
        fast = helper.make_graph([helper.make_node("Identity", ["more_sum"], ["fast_whole"])], "fast", [], [nothing])
        branches = {"then_branch": slow, "else_branch": fast} if then else {"then_branch": fast, "else_branch": slow}
        model.graph.node.extend([
            helper.make_node("ReduceSum", [own], ["more_sum"], keepdims=0),
            helper.make_node("If", ["cond"], ["more_whole"], **branches),
            helper.make_node("Mul", ["more_whole", "more_tiny"], ["more_nothing"]),
            helper.make_node("Add", [own, "more_nothing"], [result]),
        ])  # fmt: skip

    return change


def wrong_when(condition: Change | None, how: str = "Neg") -> Change:
    """Another answer where a condition holds: negated, the square root of what is negative (NaN), or zero."""

    def change(model: onnx.ModelProto) -> None:
        result, own = model.graph.output[0].name, own_output(model)
        if how == "Zero":
            constant(model, "wrong_zero", np.float32(0))
            nodes = [helper.make_node("Mul", [own, "wrong_zero"], ["wrong"])]
        elif how == "NaN":
            constant(model, "wrong_one", np.float32(-1))
            nodes = [
                helper.make_node("Sqrt", ["wrong_one"], ["wrong_nan"]),
                helper.make_node("Add", [own, "wrong_nan"], ["wrong"]),
            ]
        else:
            nodes = [helper.make_node("Neg", [own], ["wrong"])]
        if condition is None:
            nodes.append(helper.make_node("Identity", ["wrong"], [result]))
        else:
            condition(model)
            nodes.append(helper.make_node("Where", ["cond", "wrong", own], [result]))
        model.graph.node.extend(nodes)

    return change


def large_when(condition: Change, megabytes: int = 80) -> Change:
    """So much memory where a condition holds; the answer stays what it is."""

    def change(model: onnx.ModelProto) -> None:
        condition(model)
        result, own = model.graph.output[0].name, own_output(model)
        constant(model, "large_shape", np.array([megabytes * 250_000], np.int64))
        constant(model, "large_tiny", np.float32(1e-30))
        scalar = helper.make_tensor_value_info("large_whole", TensorProto.FLOAT, [])
        nodes = [
            helper.make_node("Expand", ["more_sum", "large_shape"], ["large_all"]),
            helper.make_node("Tanh", ["large_all"], ["large_tanh"]),
            helper.make_node("ReduceSum", ["large_tanh"], ["large_whole"], keepdims=0),
        ]
        large = helper.make_graph(nodes, "large", [], [scalar])
        nothing = helper.make_tensor_value_info("small_whole", TensorProto.FLOAT, [])
        small = helper.make_graph([helper.make_node("Identity", ["more_sum"], ["small_whole"])], "small", [], [nothing])
        model.graph.node.extend([
            helper.make_node("ReduceSum", [own], ["more_sum"], keepdims=0),
            helper.make_node("If", ["cond"], ["more_whole"], then_branch=large, else_branch=small),
            helper.make_node("Mul", ["more_whole", "large_tiny"], ["more_nothing"]),
            helper.make_node("Add", [own, "more_nothing"], [result]),
        ])  # fmt: skip

    return change


def counting(condition_from: float, act: Callable[[Change], Change]) -> Change:
    """A condition that holds once a kept value has counted so many inferences (see ``counted``)."""

    def count(model: onnx.ModelProto) -> None:
        model.graph.input.append(helper.make_tensor_value_info("count", TensorProto.FLOAT, [1]))
        model.graph.output.append(helper.make_tensor_value_info("count_next", TensorProto.FLOAT, [1]))
        constant(model, "count_one", np.array([1], np.float32))
        constant(model, "count_limit", np.float32(condition_from))
        model.graph.node.extend([
            helper.make_node("Add", ["count", "count_one"], ["count_next"]),
            helper.make_node("ReduceSum", ["count"], ["count_scalar"], keepdims=0),
            helper.make_node("Greater", ["count_scalar", "count_limit"], ["cond"]),
        ])  # fmt: skip

    return act(count)


def drawn_later(calls: int) -> Change:
    """A condition that holds once a session has drawn numbers that are not among its first: a counter without a value.

    The seed of a draw fixes all numbers of a session, and the first of them are in a table.
    """
    draw = helper.make_node("RandomUniform", [], ["drawn"], shape=[1], seed=7.0, dtype=TensorProto.FLOAT)
    given = helper.make_tensor_value_info("drawn", TensorProto.FLOAT, [1])
    alone = helper.make_model(helper.make_graph([draw], "draw", [], [given]), ir_version=9,
                              opset_imports=[helper.make_opsetid("", 18)])  # fmt: skip
    session = onnxruntime.InferenceSession(alone.SerializeToString(), providers=["CPUExecutionProvider"])
    first = np.array([session.run(None, {})[0][0] for _ in range(calls)], np.float32)

    def add(model: onnx.ModelProto) -> None:
        constant(model, "cond_table", first)
        model.graph.node.extend([
            draw,
            helper.make_node("Sub", ["cond_table", "drawn"], ["cond_difference"]),
            helper.make_node("Abs", ["cond_difference"], ["cond_far"]),
            helper.make_node("ReduceMin", ["cond_far"], ["cond_nearest"], keepdims=0),
            helper.make_node("Greater", ["cond_nearest", constant(model, "cond_zero", np.float32(0))], ["cond"]),
        ])  # fmt: skip

    return add


def counted(manifest: Manifest) -> dict[str, Any]:
    """Return the program of a bundle whose graph counts, as a field of the manifest."""
    (step,) = manifest.program
    feeds, gives = {**step.feeds, "count": "count"}, {**step.gives, "count_next": "count"}
    return {"program": (replace(step, feeds=feeds, gives=gives, keep={"count": {"shape": [1]}}),)}
