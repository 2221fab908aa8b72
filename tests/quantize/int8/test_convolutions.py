"""Products as 1 x 1 convolutions: ONNX Runtime computes the same, and what cannot be one stays as it was."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.graph.precision import precision_shares
from vlatool.quantize.int8._value_forms import padded_rows
from vlatool.quantize.int8.convolutions import use_convolutions

ROWS, WIDTH = 37, 24
RANDOM = np.random.default_rng(5)


def weight(*shape: int) -> np.ndarray:
    return (RANDOM.standard_normal(shape) / np.sqrt(shape[0])).astype(np.float32)


class Draft:
    """A graph that grows node by node."""

    def __init__(self, *shape: int | str) -> None:
        self.nodes: list[Any] = []
        self.tensors: dict[str, np.ndarray] = {}
        self.shape = shape or (1, ROWS, WIDTH)

    def add(self, kind: str, *inputs: str | np.ndarray, name: str = "", **options: Any) -> str:
        names = []
        for place, given in enumerate(inputs):
            names.append(given if isinstance(given, str) else f"c{len(self.nodes)}_{place}")
            if not isinstance(given, str):
                self.tensors[names[-1]] = given
        output = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, names, [output], name=name or f"n{len(self.nodes)}", **options))
        return output

    def quantized(self, value: str, scale: float = 0.05) -> str:
        pair = [np.float32(scale), np.int8(0)]
        stored = self.add("QuantizeLinear", value, *map(np.asarray, pair))
        return self.add("DequantizeLinear", stored, *map(np.asarray, pair))

    def int8(self, rows: int, columns: int, axis: int | None = 1) -> str:
        many = {0: rows, 1: columns}.get(axis, 0) if axis is not None else 0
        scale = np.full(many, 0.01, np.float32) * np.arange(1, many + 1, dtype=np.float32) if many else np.float32(0.02)
        values = RANDOM.integers(-127, 128, (rows, columns)).astype(np.int8)
        options = {} if axis is None else {"axis": axis}
        return self.add(
            "DequantizeLinear", values, np.asarray(scale, np.float32), np.zeros_like(scale, np.int8), **options
        )

    def model(self, *outputs: str, opset: int = 20) -> onnx.ModelProto:
        graph = helper.make_graph(
            self.nodes, "g", [helper.make_tensor_value_info("x", TensorProto.FLOAT, self.shape)],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
            [numpy_helper.from_array(values, name) for name, values in self.tensors.items()],
        )  # fmt: skip
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)
        return onnx.shape_inference.infer_shapes(made)


def computed(model: onnx.ModelProto, shape: Sequence[int | str]) -> list[np.ndarray]:
    onnx.checker.check_model(model)
    settings = onnxruntime.SessionOptions()
    settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=["CPUExecutionProvider"])
    sizes = [size if isinstance(size, int) else ROWS for size in shape]
    return list(session.run(None, {"x": np.random.default_rng(0).standard_normal(sizes).astype(np.float32)}))


def rewritten(draft: Draft, *outputs: str, products: int) -> list[str]:
    """Check that the rewritten graph computes the same; return its operators."""
    model = draft.model(*outputs)
    before = computed(model, draft.shape)
    assert use_convolutions(model) == products
    kinds = [node.op_type for node in model.graph.node]
    assert kinds.count("Conv") == products
    used = {name for node in model.graph.node for name in node.input}
    assert {tensor.name for tensor in model.graph.initializer} <= used
    for wanted, got in zip(before, computed(model, draft.shape), strict=True):
        assert got.shape == wanted.shape
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=2e-5)
    return kinds


@pytest.mark.parametrize("leading", [(1, ROWS), (1, 48), (3, 16), (ROWS,), (48,), (1, 2, ROWS)])
def test_a_product_with_its_bias_is_a_convolution(leading: tuple[int, ...]) -> None:
    draft = Draft(*leading, WIDTH)
    found = draft.add("Add", draft.add("MatMul", "x", weight(WIDTH, 40), name="layer/MatMul"), weight(40))
    model = draft.model(found)
    assert "MatMul" not in rewritten(draft, found, products=1)
    use_convolutions(model)
    (conv,) = [node for node in model.graph.node if node.op_type == "Conv"]
    assert conv.name == "layer/MatMul"
    assert len(conv.input) == 3
    assert ("Pad" in [node.op_type for node in model.graph.node]) == (np.prod(leading) % 8 != 0)


@pytest.mark.parametrize(
    ("rows", "wanted"), [(32, 32), (33, 40), (50, 56), (113, 120), (145, 152), (160, 160), (161, 176), (197, 208)]
)
def test_tiles_are_filled_where_that_adds_few_rows(rows: int, wanted: int) -> None:
    assert padded_rows(rows) == wanted


@pytest.mark.parametrize("transposed", [0, 1])
def test_gemm_is_a_convolution_too(transposed: int) -> None:
    draft = Draft(ROWS, WIDTH)
    shape = (40, WIDTH) if transposed else (WIDTH, 40)
    rewritten(draft, draft.add("Gemm", "x", weight(*shape), weight(40), transB=transposed), products=1)


def block(draft: Draft, value: str, *, rms: bool = False, quantize: bool = False, heads: int = 3) -> str:
    """A transformer block: normalisation, attention, residual, gated or plain feed-forward, residual."""

    def product(given: str, columns: int, rows: int = WIDTH) -> str:
        if quantize:
            return draft.add("MatMul", draft.quantized(given), draft.int8(rows, columns))
        return draft.add("MatMul", given, weight(rows, columns))

    def normalised(given: str) -> str:
        if not rms:
            return draft.add("LayerNormalization", given, weight(WIDTH), weight(WIDTH), axis=-1)
        mean = draft.add("ReduceMean", draft.add("Pow", given, np.float32(2)), np.array([-1]), keepdims=1)
        root = draft.add("Sqrt", draft.add("Add", mean, np.float32(1e-5)))
        return draft.add("Mul", draft.add("Mul", given, draft.add("Reciprocal", root)), weight(WIDTH))

    rows, size = draft.shape[1], WIDTH // heads
    inner = normalised(value)
    parts = []
    for perm in ([0, 2, 1, 3], [0, 2, 3, 1], [0, 2, 1, 3]):
        split = draft.add("Reshape", product(inner, WIDTH), np.array([1, rows, heads, size]))
        parts.append(draft.add("Transpose", split, perm=perm))
    scores = draft.add("Softmax", draft.add("MatMul", parts[0], parts[1]), axis=-1)
    mixed = draft.add("Transpose", draft.add("MatMul", scores, parts[2]), perm=[0, 2, 1, 3])
    joined = draft.add("Reshape", mixed, np.array([1, rows, WIDTH]))
    value = draft.add("Add", value, draft.add("Add", product(joined, WIDTH), weight(WIDTH)))
    inner = normalised(value)
    up = product(inner, 2 * WIDTH)
    if rms:
        gate = product(inner, 2 * WIDTH)
        up = draft.add("Mul", draft.add("Mul", gate, draft.add("Sigmoid", gate)), up)
    else:
        up = draft.add("Gelu", draft.add("Add", up, weight(2 * WIDTH)))
    return draft.add("Add", value, product(up, WIDTH, 2 * WIDTH))


@pytest.mark.parametrize("rows", [ROWS, 48])
@pytest.mark.parametrize("rms", [False, True], ids=["layer-norm", "rms-norm"])
def test_transformer_blocks_add_rows_once_and_drop_them_where_rows_mix(rms: bool, rows: int) -> None:
    draft = Draft(1, rows, WIDTH)
    kinds = rewritten(draft, block(draft, block(draft, "x", rms=rms), rms=rms), products=12 + 2 * rms)
    if rows % 16:
        assert kinds.count("Pad") == 4, "of the input, its first normalisation, and what attention gives, twice"
        assert kinds.count("Slice") == 7, "before attention, three times each, and at the end"
    else:
        assert "Pad" not in kinds
        assert "Slice" not in kinds


@pytest.mark.parametrize("rms", [False, True], ids=["layer-norm", "rms-norm"])
def test_an_int8_block_computes_what_it_did(rms: bool) -> None:
    draft = Draft()
    kinds = rewritten(draft, block(draft, "x", rms=rms, quantize=True), products=6 + rms)
    assert kinds.count("DequantizeLinear") == 2 * (6 + rms)


def test_what_attention_quantizes_is_quantized_after_the_rows_are_dropped() -> None:
    """Between a quantization and the product that it serves stands nothing that engines do not look through."""
    draft = Draft()
    product = draft.add("MatMul", draft.quantized("x"), draft.int8(WIDTH, WIDTH))
    heads = draft.add("Reshape", draft.quantized(product), np.array([1, ROWS, 2, WIDTH // 2]))
    turned = draft.add("Transpose", heads, perm=[0, 2, 1, 3])
    found = draft.add("MatMul", turned, draft.add("Transpose", heads, perm=[0, 2, 3, 1]))
    kinds = rewritten(draft, found, products=1)
    last = len(kinds) - 1 - kinds[::-1].index("QuantizeLinear")
    assert kinds[last - 1] == "Slice"


def test_the_precision_of_a_product_is_seen_through_its_new_form(tmp_path: Path) -> None:
    draft = Draft()
    model = draft.model(draft.add("MatMul", draft.quantized("x"), draft.int8(WIDTH, 8)))
    use_convolutions(model)
    onnx.save(model, tmp_path / "a.onnx")
    assert precision_shares(tmp_path / "a.onnx") == {"int8": 1.0}


def test_an_int8_product_gets_a_bias_that_changes_nothing() -> None:
    draft = Draft()
    found = draft.add("MatMul", draft.quantized("x"), draft.int8(WIDTH, 40), name="layer/MatMul")
    model = draft.model(found)
    before = computed(model, draft.shape)[0]
    use_convolutions(model)
    conv = next(node for node in model.graph.node if node.op_type == "Conv")
    bias = next(numpy_helper.to_array(tensor) for tensor in model.graph.initializer if tensor.name == conv.input[2])
    assert 0 < bias.max() < 1e-20
    np.testing.assert_allclose(computed(model, draft.shape)[0], before, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("axis", [None, 0, 1])
def test_scales_of_columns_or_of_the_whole_weight(axis: int | None) -> None:
    """A scale for each input (axis 0 of K, N) cannot be one of a convolution's outputs."""
    draft = Draft()
    rewritten(draft, draft.add("MatMul", draft.quantized("x"), draft.int8(WIDTH, 40, axis)), products=int(axis != 0))


def test_a_weight_with_two_readers_is_stored_once() -> None:
    draft = Draft()
    shared = weight(WIDTH, WIDTH)
    first = draft.add("MatMul", "x", shared)
    (name,) = draft.tensors
    found = draft.add("MatMul", draft.add("Relu", first), name)
    model = draft.model(found)
    rewritten(draft, found, products=2)
    use_convolutions(model)
    assert sum(len(tensor.dims) == 4 for tensor in model.graph.initializer) == 1


def test_what_is_read_in_both_forms_has_both() -> None:
    """A product that is an output of the graph, is reshaped, and feeds another product."""
    draft = Draft()
    first = draft.add("MatMul", "x", weight(WIDTH, WIDTH))
    flat = draft.add("Reshape", first, np.array([-1]))
    second = draft.add("MatMul", draft.add("Gelu", first), weight(WIDTH, WIDTH))
    rewritten(draft, first, flat, second, products=2)


def test_a_bias_of_each_row_or_of_the_observation_is_no_bias_of_channels() -> None:
    draft = Draft()
    first = draft.add("Add", draft.add("MatMul", "x", weight(WIDTH, WIDTH)), weight(ROWS, WIDTH)[None])
    scale = draft.add("ReduceMax", "x", np.array([1]), keepdims=1)  # (1, 1, WIDTH)
    second = draft.add("Mul", draft.add("MatMul", first, weight(WIDTH, WIDTH)), scale)
    rewritten(draft, draft.add("Sub", second, np.float32(3)), products=2)


@pytest.mark.parametrize(
    "what", ["few rows", "symbolic rows", "two activations", "three axes", "double", "alpha", "transposed", "no layer"]
)
def test_what_cannot_be_a_convolution_stays(what: str) -> None:
    shape: dict[str, Sequence[int | str]] = {"few rows": (1, 31, WIDTH), "symbolic rows": (1, "rows", WIDTH)}
    draft = Draft(*shape.get(what, (ROWS, WIDTH) if what in ("alpha", "transposed") else (1, ROWS, WIDTH)))
    if what == "two activations":
        found = draft.add("MatMul", "x", draft.add("Transpose", "x", perm=[0, 2, 1]))
    elif what == "three axes":
        found = draft.add("MatMul", "x", weight(1, WIDTH, 8))
    elif what == "double":
        doubled = draft.add("Cast", "x", to=TensorProto.DOUBLE)
        product = draft.add("MatMul", doubled, weight(WIDTH, 8).astype(np.float64))
        found = draft.add("Cast", product, to=TensorProto.FLOAT)
    elif what == "alpha":
        found = draft.add("Gemm", "x", weight(WIDTH, 8), alpha=2.0)
    elif what == "transposed":
        found = draft.add("Gemm", "x", weight(ROWS, 8), transA=1)
    elif what == "no layer":
        found = draft.add("Relu", "x")
    else:
        found = draft.add("MatMul", "x", weight(WIDTH, 8))
    model = draft.model(found)
    before = model.SerializeToString()
    assert use_convolutions(model) == 0
    assert model.SerializeToString() == before


def test_weights_that_are_inputs_of_the_graph_too_are_none_afterwards() -> None:
    """As files before IR version 4 have them."""
    draft = Draft()
    found = draft.add("MatMul", "x", weight(WIDTH, 8))
    model = draft.model(found)
    for tensor in model.graph.initializer:
        model.graph.input.append(helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
    before = computed(model, draft.shape)[0]
    assert use_convolutions(model) == 1
    assert [value.name for value in model.graph.input] == ["x"]
    np.testing.assert_allclose(computed(model, draft.shape)[0], before, rtol=1e-4, atol=2e-5)


def test_a_graph_inside_reads_values_as_they_were() -> None:
    draft = Draft()
    product = draft.add("MatMul", "x", weight(WIDTH, WIDTH))
    inside = [
        helper.make_graph([helper.make_node(kind, [product], [f"{kind}_out"])], kind, [],
                          [helper.make_tensor_value_info(f"{kind}_out", TensorProto.FLOAT, None)])
        for kind in ("Neg", "Abs")
    ]  # fmt: skip
    condition = draft.add("Greater", draft.add("ReduceMax", "x", keepdims=0), np.float32(0))
    found = draft.add("If", condition, then_branch=inside[0], else_branch=inside[1])
    rewritten(draft, found, products=1)
