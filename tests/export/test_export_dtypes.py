"""Policies that compute in other dtypes than float32, or are asked in them: right, or refused with a remedy."""

from pathlib import Path

import numpy as np
import pytest
from _full import full

from vlatool.bundle.bundle import Bundle
from vlatool.data import random_observations
from vlatool.errors import GraphError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import torch_policy
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

STATE = "{name: x, shape: [1, 17]}"
IMAGE = "{name: x, shape: [1, 3, 16, 16], dtype: uint8}"
NET = "nn.Sequential(nn.Linear(17, 32), nn.Tanh(), nn.Linear(32, 6))"
RIGHT = {
    "float64 weights": (STATE, {"a": f"{NET}.double()"}, "self.a(x.double()).float()"),
    "float16 weights": (STATE, {"a": f"{NET}.half()"}, "self.a(x.half()).float()"),
    "bfloat16 convolution": (
        IMAGE, {"a": "nn.Conv2d(3, 8, 3, 2).bfloat16()", "b": "nn.Linear(392, 6).bfloat16()"},
        "self.b(F.relu(self.a(x.bfloat16() / 255)).flatten(1)).float()",
    ),
    "bfloat16 attention": (
        "{name: x, shape: [1, 8, 16]}", {"a": "nn.TransformerEncoderLayer(16, 4, 32, batch_first=True).bfloat16()"},
        "self.a(x.bfloat16()).mean(1).float()[:, :6]",
    ),
    "bfloat16 gru": (
        "{name: x, shape: [1, 5, 17]}", {"a": "nn.GRU(17, 6, batch_first=True).bfloat16()"},
        "self.a(x.bfloat16())[0][:, -1].float()",
    ),
    "bfloat16 norms": (
        STATE, {"a": "nn.Sequential(nn.Linear(17, 64), nn.RMSNorm(64), nn.SiLU(), nn.Linear(64, 6)).bfloat16()"},
        "self.a(x.bfloat16()).float()",
    ),
    "three at once": (
        STATE,
        {"a": "nn.Linear(17, 32).bfloat16()", "b": "nn.Linear(32, 32).double()", "c": "nn.Linear(32, 6).half()"},
        "self.c(torch.tanh(self.b(self.a(x.bfloat16()).double())).half()).float()",
    ),
    "float8 weights": (
        STATE, {"a": "nn.Buffer(torch.randn(6, 17).to(torch.float8_e4m3fn))"}, "x @ self.a.float().T"
    ),
    "int8 codes": (
        STATE, {"a": "nn.Buffer(torch.randint(-127, 127, (6, 17)).char())", "b": "nn.Parameter(torch.rand(6, 1))"},
        "x @ (self.a.float() * self.b / 100).T",
    ),
    "a spectrum": (
        "{name: x, shape: [1, 32]}", {"a": "nn.Linear(17, 6)"}, "self.a(torch.fft.rfft(x).real)"
    ),
    "a constant in float64": (
        STATE, {"a": "nn.Linear(17, 6)"},
        "(self.a(x) + torch.sin(torch.arange(6, dtype=torch.float64) * x[:, :1].double())).float()",
    ),
    "beyond float16": (
        STATE, {"a": "nn.Linear(17, 6)"}, "(self.a(x) * 3e4) ** 2 / ((self.a(x) * 3e4) ** 2).mean(-1, keepdim=True)"
    ),
    "whole numbers": (STATE, {"a": "nn.Linear(17, 6)"}, "self.a(x).mul(100).round().to(torch.int32).float()"),
    "int32 ids": (
        "{name: x, shape: [1, 6], dtype: int32}", {"a": "nn.Embedding(10, 6)"}, "self.a(x.remainder(10)).sum(1)"
    ),
    "int16 ticks": ("{name: x, shape: [1, 17], dtype: int16}", {"a": "nn.Linear(17, 6)"}, "self.a(x.float() / 32768)"),
    "flags": ("{name: x, shape: [1, 17], dtype: bool}", {"a": "nn.Linear(17, 6)"}, "self.a(torch.where(x, 1.0, -1.0))"),
    "uint16 depth": (
        "{name: x, shape: [1, 1, 16, 16], dtype: uint16}", {"a": "nn.Conv2d(1, 6, 16)"},
        "self.a(x.float() / 65535).flatten(1)",
    ),
    "float16 input": ("{name: x, shape: [1, 17], dtype: float16}", {"a": "nn.Linear(17, 6)"}, "self.a(x.float())"),
    "float64 input": ("{name: x, shape: [1, 17], dtype: float64}", {"a": "nn.Linear(17, 6)"}, "self.a(x.float())"),
}  # fmt: skip
"""Case -> input, members, and what forward() returns."""
SMALL = ("bfloat16 convolution", "three at once", "uint16 depth")
COARSE = {"float16 weights": 0.003, "three at once": 0.03}
"""What a policy itself rounds, as relative L2 error; 0.03 where it computes in bfloat16."""
REFUSED = {
    "float16 action": (STATE, {"a": f"{NET}.half()"}, "self.a(x.half())", "cast it to float32"),
    "float64 action": (STATE, {"a": f"{NET}.double()"}, "self.a(x.double())", "cast it to float32"),
    "quantized by torch": (
        STATE, {"a": "torch.ao.quantization.quantize_dynamic(nn.Sequential(nn.Linear(17, 6)), {nn.Linear})"},
        "self.a(x)", "before torch quantized it",
    ),
}  # fmt: skip


def source(folder: Path, takes: str, members: dict[str, str], returns: str) -> Bundle:
    """Write a policy and take it in."""
    inits = "".join(f"        self.{name} = {value}\n" for name, value in members.items())
    (folder / "policy.py").write_text(
        "import torch\nimport torch.nn.functional as F\nfrom torch import nn\n\n\nclass Net(nn.Module):\n"
        f"    def __init__(self):\n        super().__init__()\n{inits}\n    def forward(self, x):\n"
        f"        return {returns}\n\n\ndef make():\n    torch.manual_seed(0)\n    return Net()\n"
    )
    (folder / "policy.yaml").write_text(
        f"name: net\nsource: policy.py:make\nspec:\n  inputs: [{takes}]\n"
        "  outputs: [{name: action, shape: [1, 6]}]\n  control_hz: 10\n"
    )
    for name in ("source", "exported", "int8"):
        (folder / name).mkdir()
    return TorchModule(policy=folder).run(None, folder / "source", Context()).bundle


@pytest.mark.parametrize("case", [case for case in RIGHT if full() or case in SMALL])
def test_what_is_exported_answers_as_the_policy_does(tmp_path: Path, case: str) -> None:
    policy = source(tmp_path, *RIGHT[case])
    exported = ExportOnnx().run(policy, tmp_path / "exported", Context()).bundle
    int8 = (
        DynamicInt8().run(exported, tmp_path / "int8", Context()).bundle if "nn.Linear" in str(RIGHT[case][1]) else None
    )
    torch, graphs = torch_policy(policy, 0), load(exported.path, threads=1)
    allowed = COARSE.get(case, 0.03 if "bfloat16" in case else 1e-5)
    observations = random_observations(policy.manifest.spec, 24)
    for observation in observations:
        assert relative_error(graphs.infer(observation).chunk, torch.infer(observation).chunk) <= allowed
    if int8 is not None:
        quantized = load(int8.path, threads=1)
        errors = [relative_error(quantized.infer(each).chunk, graphs.infer(each).chunk) for each in observations]
        assert np.mean(errors) < 0.05


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:torch.quantize_per_tensor:UserWarning")
@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_exported_is_refused_with_a_remedy(tmp_path: Path, case: str) -> None:
    *policy, remedy = REFUSED[case]
    with pytest.raises(GraphError) as refused:
        ExportOnnx().run(source(tmp_path, *policy), tmp_path / "exported", Context())
    assert remedy in refused.value.fix
