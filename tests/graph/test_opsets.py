"""Graphs in the opset and IR version that an engine takes: equal in what they compute, or refused by name."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper, parser

from vlatool.errors import GraphError
from vlatool.graph.opsets import fit_file, fit_versions, opset_of


def model(body: str, opset: int, ir: int = 10, domain: str = "", held: str = "") -> onnx.ModelProto:
    more = f', "{domain}" : 1' if domain else ""
    ends = f"(float[2,4] x) => (float[2,4] y) {held}"
    made = parser.parse_model(f'<ir_version: {ir}, opset_import: ["" : {opset}{more}]> g {ends} {{{body}}}')
    onnx.checker.check_model(made)
    return made


def answer(made: onnx.ModelProto) -> np.ndarray:
    feeds = {"x": np.random.default_rng(0).normal(size=(2, 4)).astype("f4")}
    return onnxruntime.InferenceSession(made.SerializeToString()).run(None, feeds)[0]


LOWERED = {
    "types alone": ("y = Relu(x)", 21, 13),
    "attributes to inputs": ("m = ReduceMean(x, a) y = Sub(x, m)", 18, 17),
    "splits and reductions": (
        "p, q = Split<axis=1, num_outputs=2>(x) r = Concat<axis=1>(q, p) "
        "m = ReduceMean<noop_with_empty_axes=0>(r, a) y = Sub(r, m)", 20, 17
    ),
    "softmax and cast": ("c = Cast<to=10>(x) d = Cast<to=1>(c) y = Softmax<axis=1>(d)", 21, 17),
    "quantized": (
        "s = Constant<value_float=0.1>() q = QuantizeLinear(x, s) y = DequantizeLinear(q, s)", 21, 13
    ),
    "another domain": ("y = com.microsoft.FastGelu(x)", 20, 17),
}  # fmt: skip


@pytest.mark.parametrize("case", LOWERED)
def test_a_lower_opset_computes_the_same(case: str) -> None:
    body, before, after = LOWERED[case]
    domain, held = "com.microsoft" if "microsoft" in body else "", "<int64[1] a = {1}>" if "a)" in body else ""
    made = model(body, before, domain=domain, held=held)
    wanted = answer(made)
    fitted = fit_versions(made, after, None)
    assert opset_of(fitted) == after
    np.testing.assert_array_equal(answer(fitted), wanted)


@pytest.mark.parametrize(
    ("body", "before", "after", "names"),
    [("y = Gelu(x)", 20, 17, "Gelu"), ("y = HardSwish(x)", 20, 13, "HardSwish"), ("y = Swish(x)", 24, 20, "Swish")],
)
def test_what_an_older_opset_lacks_is_named_or_written_otherwise(
    body: str, before: int, after: int, names: str
) -> None:
    try:
        fitted = fit_versions(model(body, before), after, None)
    except GraphError as error:
        text = error.message
    else:  # a function, which the converter wrote out
        text = "" if names in {node.op_type for node in fitted.graph.node} else names
    assert names in text


def test_nothing_changes_where_the_versions_fit(tmp_path: Path) -> None:
    made = model("y = Relu(x)", 18, ir=8)
    onnx.save(made, tmp_path / "g.onnx")
    before = (tmp_path / "g.onnx").read_bytes()
    assert fit_file(tmp_path / "g.onnx", 20, 10) == 18
    assert (tmp_path / "g.onnx").read_bytes() == before
    assert fit_versions(made, 20, 10) is made


def test_a_newer_file_format_is_lowered_where_its_types_allow(tmp_path: Path) -> None:
    made = model("y = Relu(x)", 18, ir=13)
    assert fit_versions(made, None, 11).ir_version == 11
    codes = helper.make_tensor("w", onnx.TensorProto.INT4, [2], b"\x21", raw=True)
    made.graph.initializer.append(codes)
    made.ir_version = 10
    with pytest.raises(GraphError, match="int4, which IR version 9 lacks"):
        fit_versions(made, None, 9)
