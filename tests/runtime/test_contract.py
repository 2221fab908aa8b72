"""What graphs give and take is what the spec declares, or nothing is opened and nothing returned."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _written import MEMORY, SUM, X, Y, written

from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import GraphError, SpecError
from vlatool.runtime import load
from vlatool.runtime.contract import Outputs, Port, check_chunk, written_as_declared

ENGINES = pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
LOGITS = TensorSpec("y", (1, 3), kind="discrete", labels=("left", "right", "forward"))
SEVEN = TensorSpec("y", (1, 8, 7))


@ENGINES
@pytest.mark.parametrize(
    ("text", "output", "chunk", "told"),
    [
        ("g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", LOGITS, 1, r"float32 \[1, 3\].*float32 \[1, 2\]"),
        (
            "g (float[1,2] x) => (float[1,8,14] y) <int64[3] s = {1,8,14}, int64[2] r = {1,56}>"
            "{ t = Tile(x, r)  y = Reshape(t, s) }",
            SEVEN, 8, r"float32 \[1, 8, 7\].*float32 \[1, 8, 14\]",
        ),
        (
            "g (float[1,2] x) => (float[1,112] y) <int64[2] r = {1,56}> { y = Tile(x, r) }",
            SEVEN, 8, r"float32 \[1, 8, 7\].*float32 \[1, 112\]",
        ),
        ("g (float[1,2] x) => (double[1,2] y) { y = Cast<to = 11>(x) }", Y, 1, r"float32 \[1, 2\].*float64 \[1, 2\]"),
        ("g (float[1,2] x) => (int64[1,2] y) { y = Cast<to = 7>(x) }", Y, 1, r"float32 \[1, 2\].*int64 \[1, 2\]"),
    ],
    ids=["two logits", "wider", "flat", "float64", "int64"],
)  # fmt: skip
def test_a_graph_that_gives_something_else_is_refused_at_load(tmp_path: Path, engine, text, output, chunk, told):
    bundle = written(tmp_path, text, outputs=(output,), chunk=chunk)
    with pytest.raises(GraphError, match=told) as caught:
        load(bundle.path, engine=engine)
    assert "export" in caught.value.fix


def test_the_advice_for_another_dtype_is_a_cast(tmp_path: Path):
    bundle = written(tmp_path, "g (float[1,2] x) => (double[1,2] y) { y = Cast<to = 11>(x) }")
    with pytest.raises(GraphError) as caught:
        load(bundle.path)
    assert "cast it to float32" in caught.value.fix


@ENGINES
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("g (float[1,3] x) => (float[1,2] y) <int64[1] a = {0}, int64[1] b = {2}, int64[1] c = {1}>"
         "{ y = Slice(x, a, b, c) }", r"takes 'x' as float32 \[1, 3\], but the spec declares 'x' as float32 \[1, 2\]"),
        ("g (double[1,2] x) => (float[1,2] y) { y = Cast<to = 1>(x) }", r"takes 'x' as float64 \[1, 2\]"),
        ("g (float[1,2] z) => (float[1,2] y) { y = Neg(z) }", "takes no 'x'"),
        ("g (float[1,2] x) => (float[1,2] z) { z = Neg(x) }", "gives no 'y'"),
        ("g (float[1,2] x, float[1,2] z) => (float[1,2] y) { y = Add(x, z) }", "takes 'z', which the program does not"),
    ],
    ids=["width", "dtype", "input", "output", "unfed"],
)  # fmt: skip
def test_a_graph_that_takes_something_else_is_refused_at_load(tmp_path: Path, engine, text, told):
    with pytest.raises(GraphError, match=told):
        load(written(tmp_path, text).path, engine=engine)


@ENGINES
def test_what_is_declared_loads(tmp_path: Path, engine):
    bundle = written(tmp_path, SUM, program=MEMORY)
    policy = load(bundle.path, engine=engine)
    np.testing.assert_array_equal(policy.infer({"x": [1.0, 2.0]}).chunk, [[2, 4]])
    np.testing.assert_array_equal(policy.infer({"x": [1.0, 2.0]}).chunk, [[4, 8]])


def test_a_kept_value_of_another_shape_is_refused_at_load(tmp_path: Path):
    program = (replace(MEMORY[0], keep={"h": {"shape": [1, 3]}}),)
    with pytest.raises(GraphError, match=r"takes 'h' as float32 \[1, 2\], but the program makes 'h' as float32 \[1, 3"):
        load(written(tmp_path, SUM, program=program).path)


def test_a_carried_value_must_fit_the_next_repeat(tmp_path: Path):
    text = "g (float[1,2] x) => (float[1,4] y) { y = Concat<axis = 1>(x, x) }"
    program = (ProgramStep("main", {"x": "x"}, {"y": "y"}, repeat=2, carry={"y": "x"}),)
    wide = replace(Y, shape=(1, 4))
    with pytest.raises(GraphError, match="in the next repeat"):
        load(written(tmp_path, text, outputs=(wide,), program=program).path)


@ENGINES
def test_a_free_axis_is_held_against_the_spec_when_it_is_known(tmp_path: Path, engine):
    free = TensorSpec("x", (1, "n"))
    policy = load(written(tmp_path, "g (float[1,N] x) => (float[1,N] y) { y = Neg(x) }", (free,)).path, engine=engine)
    np.testing.assert_array_equal(policy.infer({"x": [1.0, 2.0]}).chunk, [[-1, -2]])
    with pytest.raises(GraphError, match=r"gives 'y' as float32 \[1, 3\]; the spec declares float32 \[1, 2\]"):
        policy.infer({"x": [1.0, 2.0, 3.0]})
    np.testing.assert_array_equal(policy.infer({"x": [1.0, 2.0]}).chunk, [[-1, -2]])


def test_a_further_output_that_is_not_finite_is_refused(tmp_path: Path):
    text = "g (float[1,2] x) => (float[1,2] y, float[1,2] value) { y = Tanh(x)  value = Add(x, x) }"
    policy = load(written(tmp_path, text, outputs=(Y, TensorSpec("value", (1, 2)))).path)
    assert policy.infer({"x": [1.0, 2.0]}).outputs["value"].tolist() == [[2, 4]]
    with pytest.raises(GraphError, match="output 'value' is not finite"):
        policy.infer({"x": [3e38, 3e38]})


@pytest.mark.parametrize(
    ("shape", "kind", "chunk"),
    [((1, 7), "tensor", 1), ((1, 8, 7), "tensor", 8), ((8, 7), "tensor", 8), ((1,), "tensor", 1),
     ((1, 3), "discrete", 1), ((1, 4, 3), "discrete", 4), ((1, "t", 7), "tensor", 5)],
)  # fmt: skip
def test_a_chunk_that_fits_the_shape(shape, kind, chunk):
    labels = ("a", "b", "c") if kind == "discrete" else ()
    check_chunk(PolicySpec((X,), (TensorSpec("y", shape, kind=kind, labels=labels),), 10, chunk))


@pytest.mark.parametrize(("shape", "chunk", "right"), [((1, 8, 7), 1, 8), ((1, 8, 7), 9, 8), ((1, 7), 7, 1)])
def test_a_chunk_that_the_shape_does_not_hold(tmp_path: Path, shape, chunk, right):
    spec = PolicySpec((X,), (TensorSpec("y", shape),), 10, chunk)
    with pytest.raises(SpecError, match=f"chunk {chunk}; the shape .* holds {right} action") as caught:
        check_chunk(spec)
    assert f"chunk: {right}" in caught.value.fix


def test_load_looks_at_the_chunk(tmp_path: Path):
    with pytest.raises(SpecError, match="chunk 2"):
        load(written(tmp_path, "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", chunk=2).path)


@pytest.mark.parametrize(
    ("one", "two", "fit"),
    [
        (Port((1, None), "float32"), Port((1, 7), "float32"), True),
        (Port(None, "float32"), Port((1, 7), "float32"), True),
        (Port((1, 7), "float32"), Port((1, 7), "float16"), False),
        (Port((1, 7), "float32"), Port((7,), "float32"), False),
    ],
)
def test_ports_fit_where_they_can_be_one_array(one, two, fit):
    assert one.fits(two) == two.fits(one) == fit


def test_an_output_that_may_have_any_length_is_returned():
    values = {"y": np.zeros((1, 9), np.float32)}
    assert Outputs((TensorSpec("y", (1, "n")),))(values) == values


def test_a_free_axis_without_an_element_is_no_action(tmp_path: Path):
    text = "g (float[1,2] x) => (float[1,N] y) { a = NonZero(x)  b = Cast<to = 1>(a)  i = Constant<value_ints = [0]>()"
    text += "  j = Constant<value_ints = [1]>()  y = Slice(b, i, j, i) }"
    policy = load(written(tmp_path, text, outputs=(TensorSpec("y", (1, "n")),)).path)
    assert policy.infer({"x": [1.0, 2.0]}).chunk.shape == (1, 2)
    with pytest.raises(GraphError, match=r"gives 'y' as float32 \[1, 0\]"):
        policy.infer({"x": [0.0, 0.0]})


def test_an_action_of_float16_reaches_the_controller_as_float32(tmp_path: Path):
    bundle = written(
        tmp_path,
        "g (float[1,2] x) => (float16[1,2] y) { y = Cast<to = 10>(x) }",
        outputs=(replace(Y, dtype="float16"),),
    )
    action = load(bundle.path).infer({"x": [1.0, 2.0]})
    assert (action.chunk.dtype, action.outputs["y"].dtype) == (np.float32, np.float16)


def test_shape_and_dtype_are_not_looked_at_where_the_engine_cannot_give_others(tmp_path: Path):
    plain = load(written(tmp_path / "plain", "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }").path)
    assert written_as_declared(plain.bundle.manifest, plain.program.sessions) == {"y"}
    free = "g (float[1,N] x) => (float[1,N] y) { y = Neg(x) }"
    free_policy = load(written(tmp_path / "free", free, outputs=(TensorSpec("y", (1, "n")),)).path)
    assert written_as_declared(free_policy.bundle.manifest, free_policy.program.sessions) == set()


def test_what_a_program_makes_in_another_way_is_looked_at():
    session = SimpleNamespace(bound=True)
    spec = PolicySpec((X,), (Y,), 10, 1)
    step = ProgramStep("g", {"x": "x"}, {"out": "y"})
    for steps in ((step, step), (replace(step, gives={"out": "z"}, carry={"z": "y"}),)):
        manifest = SimpleNamespace(spec=spec, program=steps)
        assert written_as_declared(manifest, {"g": session}) == set()
    assert written_as_declared(SimpleNamespace(spec=spec, program=(step,)), {"g": session}) == {"y"}
    assert written_as_declared(SimpleNamespace(spec=spec, program=(step,)), {"g": object()}) == set()


def test_what_is_certain_is_returned_unseen_but_for_numbers_that_are_not_finite():
    outputs = Outputs((Y, replace(Y, name="z")), action=False, certain={"y", "z"})
    assert list(outputs({"y": 1, "z": np.ones((1, 2), np.float32), "more": 2})) == ["y", "z"]
    with pytest.raises(GraphError, match="'z' is not finite"):
        outputs({"y": 1, "z": np.full((1, 2), np.nan, np.float32)})


@ENGINES
def test_a_graph_that_gives_another_shape_than_it_declares_fails(tmp_path: Path, engine):
    text = "g (float[1,2] x) => (float[1,2] y) { a = NonZero(x)  b = Cast<to = 1>(a)  i = Constant<value_ints = [0]>()"
    text += "  j = Constant<value_ints = [1]>()  y = Slice(b, i, j, i) }"
    policy = load(written(tmp_path, text).path, engine=engine)
    policy.infer({"x": [1.0, 2.0]})
    with pytest.raises(GraphError):
        policy.infer({"x": [1.0, 0.0]})
