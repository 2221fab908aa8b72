"""What is alike in all repeats of a graph is computed once, and the policy gives the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnx_ir
import onnxruntime
import pytest

from vlatool.bundle.program import ProgramStep, check_program, latent_names
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.graph.graph_cut import GraphCut
from vlatool.graph.loop_invariants import changing_feeds, compute_once, cut_loop_invariants
from vlatool.runtime.program import Program

SPEC = PolicySpec((TensorSpec("c", (1, 5, 16)),), (TensorSpec("a", (1, 3, 16)),), 10.0, 3)
STEP = ProgramStep(
    "step", {"c": "c", "x": "x"}, {"y": "a"}, 4, {"a": "x"}, noise={"x": {"shape": [1, 3, 16]}}
)  # fmt: skip
CROSS = """
    k = MatMul(c, w)
    kb = Add(k, b)
    kt = Transpose<perm = [0, 2, 1]>(kb)
    s = MatMul(x, kt)
    p = Softmax(s)
    m = MatMul(p, kb)
    y = Add(x, m)
"""
HEAD = "step (float[1,5,16] c, float[1,3,16] x) => (float[1,3,16] y)"


def model(body: str, head: str = HEAD) -> Any:
    """Return an ``onnx_ir.Model``: weights w (16, 16), narrow (2, 16) and b (16)."""
    random = np.random.default_rng(0)
    text = f'<ir_version: 10, opset_import: ["" : 20]> {head} {{ {body} }}'
    proto = onnx.parser.parse_model(text)
    for name, shape in {"w": (16, 16), "narrow": (2, 16), "b": (16,)}.items():
        if name in text:
            values = random.normal(size=shape).astype(np.float32) / 4
            proto.graph.initializer.append(onnx.numpy_helper.from_array(values, name))
    return onnx_ir.from_proto(onnx.shape_inference.infer_shapes(proto))


class Session:
    """A graph in ONNX Runtime."""

    def __init__(self, graph: Any) -> None:
        proto = onnx_ir.to_proto(graph)
        onnx.checker.check_model(proto, full_check=True)
        self._session = onnxruntime.InferenceSession(proto.SerializeToString(), providers=["CPUExecutionProvider"])

    def run(self, feeds: Mapping[str, Any]) -> dict[str, Any]:
        names = [each.name for each in self._session.get_outputs()]
        return dict(zip(names, self._session.run(None, dict(feeds)), strict=True))


def cut(body: str, step: ProgramStep = STEP, head: str = HEAD) -> tuple[Any, Any]:
    """Return the cut and what is left; both give together what the whole gives."""
    whole, rest = model(body, head), model(body, head)
    found = cut_loop_invariants(rest, changing_feeds([step], "step") or ())
    if found is not None:
        program = compute_once([step], "step", "once", found)
        check_program(program, ["step", "once"], SPEC)
        values = {"c": np.random.default_rng(1).normal(size=(1, 5, 16)).astype(np.float32)}
        wanted = Program([step], {"step": Session(whole)}, 3).run(dict(values))["a"]
        got = Program(program, {"step": Session(rest), "once": Session(found.model)}, 3).run(dict(values))["a"]
        np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-6)
    return found, rest


def operators(graph: Any) -> list[str]:
    return [node.op_type for node in graph.graph]


def test_keys_and_values_of_a_prefix_are_computed_once():
    found, rest = cut(CROSS)
    assert operators(found.model) == ["MatMul", "Add", "Transpose"]
    assert operators(rest) == ["MatMul", "Softmax", "MatMul", "Add"]
    assert (found.inputs, found.values, found.kept) == (("c",), ("kb", "kt"), ("x",))
    assert not rest.graph.initializers
    assert list(found.model.graph.initializers) == ["b", "w"], "in one order"


def test_what_is_still_read_stays_an_input():
    found, _ = cut(CROSS.replace("y = Add(x, m)", "t = ReduceSum(c) n = Add(m, t) y = Add(x, n)"))
    assert found.kept == ("c", "x")


def test_a_constant_that_both_read_is_in_both():
    found, rest = cut(CROSS.replace("y = Add(x, m)", "n = Add(m, b) y = Add(x, n)"))
    assert "b" in found.model.graph.initializers
    assert "b" in rest.graph.initializers


def test_what_follows_moves_only_while_it_does_not_grow():
    grow = CROSS.replace("s = MatMul(x, kt)", "big = Concat<axis = 1>(kb, kb, kb) e = ReduceSum(big) q = Add(x, e)"
                         " s = MatMul(q, kt)")  # fmt: skip
    found, rest = cut(grow)
    assert "Concat" in operators(rest)
    assert "big" not in found.values


@pytest.mark.parametrize(
    "body",
    [
        "e = ReduceSum(c) t = Tanh(e) y = Add(x, t)",  # no product
        "q = MatMul(x, w) y = Add(x, q)",  # a product of what changes
        "q = MatMul(w, w) r = MatMul(x, q) y = Add(x, r)",  # a constant, which the engine folds
        "i = Shape(c) y = Identity(x)",
    ],
)
def test_nothing_is_moved_where_nothing_is_saved(body):
    assert cut(body)[0] is None


def test_nothing_is_moved_where_more_is_carried_than_saved():
    narrow = "step (float[1,5,2] c, float[1,3,16] x) => (float[1,3,16] y)"
    body = CROSS.replace("MatMul(c, w)", "MatMul(c, narrow)")
    assert cut_loop_invariants(model(body, narrow), {"x"}) is None
    assert cut_loop_invariants(model(CROSS), {"x"}) is not None


def test_a_shape_that_is_not_known_moves_nothing():
    head = HEAD.replace("[1,5,16]", "[1,N,16]")
    assert cut_loop_invariants(model(CROSS, head), {"x"}) is None


def test_an_output_of_the_policy_is_still_given_by_its_graph():
    head = HEAD.replace("y)", "y, float[1,5,16] kb)")
    rest = model(CROSS, head)
    found = cut_loop_invariants(rest, {"x"})
    assert [value.name for value in rest.graph.outputs] == ["y", "kb"]
    assert found is None or "kb" not in found.values


def test_a_branch_reads_what_is_computed_once():
    body = CROSS.replace(
        "y = Add(x, m)",
        """r = ReduceSum<keepdims = 0>(m)  z = Sub(r, r)  g = Greater(r, z)
        h = If (g) <then_branch = t () => (float[1,5,16] u) { u = Add(kb, kb) },
                    else_branch = e () => (float[1,5,16] v) { v = Identity(kb) }>
        n = ReduceSum(h)  y = Add(x, n)""",
    )
    found, rest = cut(body)
    assert "If" in operators(rest)
    assert "kb" in found.values


@pytest.mark.parametrize(
    ("step", "changing"),
    [
        (STEP, {"x"}),
        (ProgramStep("step", {"c": "c", "x": "t"}, {"y": "a"}, 2, schedule={"t": [1.0, 2.0]}), {"x"}),
        (ProgramStep("step", {"c": "c", "x": "a"}, {"y": "a"}, 2), {"x"}),
        (ProgramStep("step", {"c": "c", "x": "x"}, {"y": "c"}, 2), {"c"}),
        (ProgramStep("step", {"c": "c", "x": "x"}, {"y": "a"}), None),
        (ProgramStep("other", {"c": "c", "x": "x"}, {"y": "a"}, 3), None),
    ],
)
def test_the_program_says_what_changes(step, changing):
    assert changing_feeds([step], "step") == changing


def test_what_follows_from_a_slow_part_alone_is_computed_with_it():
    slow = {"max_age_ms": 500.0}
    think = ProgramStep("think", {"image": "image"}, {"context": "context"}, slow=slow)
    see = ProgramStep("see", {"state": "state"}, {"seen": "seen"})
    act = ProgramStep("act", {"k": "context", "s": "seen", "x": "x"}, {"y": "x_next"}, 4, {"x_next": "x"},
                      noise={"x": {"shape": [1, 2]}})  # fmt: skip
    of_context = GraphCut(None, ("k",), ("keys",), ("s", "x"))
    of_both = GraphCut(None, ("k", "s"), ("keys",), ("x",))
    program = compute_once((think, see, act), "act", "once", of_context)
    assert [(step.graph, step.slow) for step in program] == [("think", slow), ("once", slow), ("see", {}), ("act", {})]
    assert program[3].feeds == {"keys": "once.keys", "s": "seen", "x": "x"}
    spec = PolicySpec((TensorSpec("image", (1, 2)), TensorSpec("state", (1, 2))), (TensorSpec("x_next", (1, 2)),), 10.0)
    check_program(program, ["think", "once", "see", "act"], spec)
    assert latent_names(program, spec) == {"once.keys"}
    program = compute_once((think, see, act), "act", "once", of_both)
    assert [step.graph for step in program if not step.slow] == ["see", "once", "act"]
    program = compute_once((replace(think, slow={}), see, act), "act", "once", of_context)
    assert [step.graph for step in program] == ["think", "see", "once", "act"]


def test_noise_that_stays_is_drawn_before_it_is_read():
    noise = {"c": {"shape": [1, 5, 16]}, "x": {"shape": [1, 3, 16]}}
    step = ProgramStep("step", {"c": "c", "x": "x"}, {"y": "a"}, 4, {"a": "x"}, noise=noise)
    found, _ = cut(CROSS, step)
    first, rest = compute_once([step], "step", "once", found)
    assert (first.noise, rest.noise) == (noise, {})
    first, rest = compute_once([STEP], "step", "once", found)
    assert (first.noise, rest.noise) == ({}, STEP.noise)
