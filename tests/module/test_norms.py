from collections import Counter

import numpy as np
import onnx
import onnx_ir
import onnxruntime
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.module.norms import divide_by_roots
from vlatool.module.to_onnx import exported_by_torch

STEP = ProgramStep("main", {"x": "x"}, {"y": "y"})


class Norm(nn.Module):
    """As Llama and its kin write it."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.linspace(0.5, 2.0, width))

    def forward(self, x):
        return self.weight * (x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + 1e-6))


class Two(nn.Module):
    """A root that a product reads twice, and one that something else reads."""

    def forward(self, x):
        near = torch.rsqrt(x.abs() + 1.0)
        far = torch.rsqrt(x.abs() + 2.0)
        return x * near + 3.0 * near + x * far + far.exp() + torch.rsqrt(x.abs() + 3.0) * torch.rsqrt(x.abs() + 4.0)


def graph_of(module, tmp_path, **options):
    given = torch.linspace(-2, 3, 48).reshape(1, 3, 16)
    exported = exported_by_torch(module.eval(), (given,), STEP, 20, **options)
    exported.save(str(tmp_path / "norm.onnx"))
    return tmp_path / "norm.onnx", given


def operators(path):
    return Counter(node.op_type for node in onnx.load(path).graph.node)


@pytest.mark.parametrize("module", [Norm(), nn.RMSNorm(16)], ids=["by hand", "of torch"])
def test_onnx_runtime_fuses_an_rms_norm(tmp_path, module):
    path, given = graph_of(module, tmp_path)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.optimized_model_filepath = str(tmp_path / "fused.onnx")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    (got,) = session.run(None, {"x": given.numpy()})
    assert operators(tmp_path / "fused.onnx") == {"SimplifiedLayerNormalization": 1}
    np.testing.assert_allclose(got, module(given).detach().numpy(), rtol=1e-5)


def test_a_graph_whose_weights_are_streamed_has_quotients_too(tmp_path):
    path, _ = graph_of(Norm(), tmp_path, optimize=False)
    assert (operators(path)["Reciprocal"], operators(path)["Div"]) == (0, 1)


def test_only_what_products_read_becomes_a_quotient(tmp_path):
    path, given = graph_of(Two(), tmp_path)
    assert operators(path)["Reciprocal"] >= 1
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (got,) = session.run(None, {"x": given.numpy()})
    np.testing.assert_allclose(got, Two()(given).numpy(), rtol=1e-5)


def test_a_reciprocal_that_is_an_output_or_of_no_root_stays():
    text = """<ir_version: 10, opset_import: ["": 20]>
        g (float[4] x, float[4] z) => (float[4] a, float[4] b, float[4] c) {
          r = Sqrt(x)  a = Reciprocal(r)  b = Mul(a, z)  q = Reciprocal(x)  c = Mul(q, z) }"""
    model = onnx_ir.from_onnx_text(text)
    assert divide_by_roots(model) == 0
    assert [node.op_type for node in model.graph] == ["Sqrt", "Reciprocal", "Mul", "Reciprocal", "Mul"]
