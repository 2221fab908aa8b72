"""Gemms with factors and turned operands: the same values, in the form that every method quantizes."""

from pathlib import Path

import numpy as np
import onnx
import onnx_ir
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.export.onnx import ExportOnnx
from vlatool.graph.gemm_factors import extract_gemm_factors
from vlatool.graph.layers import find_layers
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.runtime import load
from vlatool.sources.onnx import OnnxFile
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context


def gemm(bias: str = "constant", **attributes: float) -> onnx.ModelProto:
    """A Gemm over a state of 16 (turned: 16 x 1) to an action of 6."""
    random = np.random.default_rng(0)
    shape = [16, 1] if attributes.get("transA") else [1, 16]
    weights = [random.normal(size=(6, 16) if attributes.get("transB") else (16, 6)), random.normal(size=6)]
    stored = [numpy_helper.from_array(value.astype("f4"), name) for value, name in zip(weights, "WC", strict=True)]
    value = helper.make_tensor_value_info
    inputs = {"constant": ["x", "W", "C"], "none": ["x", "W"], "given": ["x", "W", "y"]}[bias]
    nodes = [
        helper.make_node("Mul", ["state", "state"], ["x"]),
        helper.make_node("ReduceSum", ["state"], ["y"], keepdims=1),
        helper.make_node("Gemm", inputs, ["action"], "head", **attributes),
    ]
    graph = helper.make_graph(
        nodes, "g", [value("state", TensorProto.FLOAT, shape)], [value("action", TensorProto.FLOAT, [1, 6])], stored
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


CASES = {
    "alpha": {"alpha": 0.5},
    "beta": {"beta": 2.0},
    "both, turned weight": {"alpha": 0.5, "beta": -1.0, "transB": 1},
    "given bias": {"bias": "given", "beta": 0.25},
    "no bias": {"bias": "none", "alpha": -3.0, "beta": 7.0},
    "turned": {"transA": 1, "alpha": 2.0},
}


@pytest.mark.parametrize("case", CASES)
def test_the_same_values_and_a_layer(case: str) -> None:
    model = gemm(**CASES[case])  # type: ignore[arg-type]
    changed = onnx_ir.from_proto(model)
    assert extract_gemm_factors(changed) == 1
    assert extract_gemm_factors(changed) == 0
    plain = onnx_ir.to_proto(changed)
    onnx.checker.check_model(plain, full_check=True)
    random = np.random.default_rng(1)
    sessions = [ort.InferenceSession(each.SerializeToString(), providers=["CPUExecutionProvider"])
                for each in (model, plain)]  # fmt: skip
    shape = sessions[0].get_inputs()[0].shape
    for _ in range(8):
        state = {"state": random.normal(size=shape).astype("f4")}
        before, after = (session.run(None, state)[0] for session in sessions)
        np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5)
    assert [layer.name for layer in find_layers(plain, ("Gemm",))] == ["head"]


@pytest.mark.parametrize("method", [DynamicInt8, WeightOnly, StaticInt8])
def test_every_method_quantizes_them(tmp_path: Path, method: type) -> None:
    onnx.save(gemm(alpha=0.5, beta=2.0, transB=1), tmp_path / "p.onnx")
    for name in ("float", "int8"):
        (tmp_path / name).mkdir()
    bundle = OnnxFile(model=tmp_path / "p.onnx").run(None, tmp_path / "float", Context()).bundle
    options = {}
    if method is StaticInt8:
        np.savez(tmp_path / "c.npz", state=np.random.default_rng(0).normal(size=(64, 16)).astype("f4"))
        options["calibration"] = tmp_path / "c.npz"
    made = method(**options).run(bundle, tmp_path / "int8", Context()).bundle
    assert "float32" not in made.manifest.graphs["main"].precision
    load(made.path, threads=1)


def test_torchs_addmm_with_factors_is_a_layer(tmp_path: Path) -> None:
    (tmp_path / "policy.py").write_text(
        "import torch\nfrom torch import nn\n\n\nclass Net(nn.Module):\n    def __init__(self):\n"
        "        super().__init__()\n        self.weight = nn.Parameter(torch.randn(16, 6))\n"
        "        self.bias = nn.Parameter(torch.randn(6))\n\n    def forward(self, x):\n"
        "        return torch.addmm(self.bias, x, self.weight, beta=0.5, alpha=2.0)\n\n\n"
        "def make():\n    return Net()\n"
    )
    (tmp_path / "policy.yaml").write_text(
        "name: net\nsource: policy.py:make\nspec:\n  inputs: [{name: x, shape: [1, 16]}]\n"
        "  outputs: [{name: action, shape: [1, 6]}]\n  control_hz: 10\n"
    )
    for name in ("source", "exported", "int8"):
        (tmp_path / name).mkdir()
    source = TorchModule(policy=tmp_path).run(None, tmp_path / "source", Context()).bundle
    exported = ExportOnnx().run(source, tmp_path / "exported", Context()).bundle
    assert DynamicInt8().run(exported, tmp_path / "int8", Context()).bundle.manifest.graphs["main"].precision == {
        "int8": 1.0
    }
