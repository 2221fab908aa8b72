"""The smallest policy for each cause for which an export fails: the cause, torch's line, the place, the remedy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, SourceError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.failures import CAUSES
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

YAML = """\
name: small
source: policy.py:make
spec:
  inputs: [{name: x, shape: [1, 3]}]
  outputs: [{name: y, shape: [1, 2]}]
  control_hz: 10
"""
HEAD = """\
import torch
from torch import nn

class Inner(nn.Module):
    def forward(self, x):
        return torch.cdist(x, x)

class Language(nn.Module):
    def generate(self, x):
        while x.sum() < 5:
            x = x + x.abs() + 1
        return x

library = torch.library.Library("mine", "FRAGMENT")
if not hasattr(torch.ops.mine, "twice"):
    library.define("twice(Tensor x) -> Tensor")
    library.impl("twice", lambda x: x * 2, "CPU")
    library.impl("twice", torch.empty_like, "Meta")

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(3, 2)
        self.inner, self.language = Inner(), Language()
        self.scripted = torch.jit.script(nn.Linear(3, 3)) if SCRIPTED else None
        self.random = torch.Generator()

    def forward(self, TAKES):
        BODY

def make():
    torch.manual_seed(0)
    return Policy()
"""
DYNAMIC = "torch.ao.quantization.quantize_dynamic(nn.Sequential(nn.Linear(3, 3)), {nn.Linear}, dtype=torch.qint8)"
Export = Callable[..., Bundle]


@pytest.fixture
def export(tmp_path: Path) -> Export:
    """A function that exports the policy whose ``forward`` has this body, with dynamo alone."""

    def run(body: str, description: str = YAML, takes: str = "x") -> Bundle:
        folder, out = tmp_path / "policy", tmp_path / "out"
        for each in (folder, tmp_path / "source", out):
            each.mkdir()
        code = HEAD.replace("BODY", body.replace("\n", "\n        ")).replace("TAKES", takes)
        code = code.replace("SCRIPTED", str("scripted(" in body))
        code = code.replace("QUANTIZED(", "self.quantized(").replace(
            "self.random =", f"self.quantized = {DYNAMIC if 'QUANTIZED' in body else None}\n        self.random ="
        )
        (folder / "policy.py").write_text(code)
        (folder / "policy.yaml").write_text(description)
        source = TorchModule(policy=folder).run(None, tmp_path / "source", Context()).bundle
        return ExportOnnx(exporter="dynamo").run(source, out, Context()).bundle

    return run


FAILS = {
    "data-dependent control flow": (
        "if x.sum() > 0:\n    x = x + 1\nreturn self.linear(x)", "GuardOnDataDependent", "if x.sum() > 0:",
        "torch.where",
    ),
    "a distribution that checks its parameters": (
        "return torch.distributions.Normal(self.linear(x), 1.0).mean", "data-dependent", "Normal(self.linear(x), 1.0)",
        "its mean, its logits",
    ),
    "a shape that depends on values": (
        "y = x[x > 0]\nif y.shape[0] > 2:\n    y = y * 2\nreturn self.linear(x) + y.sum()", "u0 > 2", "y.shape[0] > 2",
        "mask",
    ),
    "an operator that ONNX lacks": (
        "return self.linear(x) + self.inner(x).sum()", "aten._cdist_forward", "module inner", "make()"
    ),
    "an operator of a package of its own": (
        "return self.linear(torch.ops.mine.twice(x))", "mine.twice", "mine.twice", "torch's own operators"
    ),
    "arguments that the exporter does not translate": (
        "return self.linear(x) + torch.histc(x, bins=2)", "min == max", "aten.histc", "explicit arguments"
    ),
    "a generator of random numbers": (
        "return self.linear(x + torch.randn(1, 3, generator=self.random))", "Optional[Generator]", "aten.randn",
        "noise:",
    ),
    "generate() inside forward()": (
        "return self.linear(self.language.generate(x))", "GuardOnDataDependent", "while x.sum() < 5:", "decoding step"
    ),
    "a TorchScript module": (
        "return self.linear(self.scripted(x))", "Linear.forward()", "self.scripted(x)", "torch.export.save"
    ),
    "weights that torch has quantized": (
        "return self.linear(QUANTIZED(x))", "LinearPackedParamsBase", "", "vlatool quantize"
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:torch.ao.quantization is deprecated:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:torch.quantize_per_tensor:UserWarning")
@pytest.mark.parametrize("cause", FAILS)
def test_a_failed_export_says_cause_line_place_and_remedy(
    cause: str, export: Export, capfd: pytest.CaptureFixture[str]
) -> None:
    body, line, place, remedy = FAILS[cause]
    with pytest.raises(GraphError) as caught:
        export(body)
    told = caught.value.message
    assert told.startswith(f"torch cannot export the graph 'main': {cause}: ")
    assert line in told
    assert place in told
    assert remedy in caught.value.fix
    assert len(told.splitlines()) == 1
    assert "Next steps" not in told
    assert "def forward(" not in "".join(capfd.readouterr()), "torch's graph, of up to thousands of lines"


RUNS = {
    "devices": ("return self.linear(x.to('meta'))", "module.to('cpu')"),
    "dtypes": ("return self.linear(x.double())", "module.float()"),
    "shapes": ("return self.linear(x[:, :2])", "correct the shapes in the spec"),
    "no tensor": ("return {'y': self.linear(x)}", "in the order of 'gives'"),
}


@pytest.mark.parametrize("case", RUNS)
def test_a_module_that_fails_before_it_is_exported_has_its_remedy(case: str, export: Export) -> None:
    body, remedy = RUNS[case]
    with pytest.raises(SourceError) as caught:
        export(body)
    assert remedy in caught.value.fix


def test_an_input_that_forward_changes_in_place_changes_nowhere_else(export: Export) -> None:
    made = load(export("x.add_(1)\nreturn self.linear(x)").path, threads=1)
    first = made.infer({"x": np.ones((1, 3), np.float32)})
    again = made.infer({"x": np.ones((1, 3), np.float32)})
    np.testing.assert_array_equal(first.outputs["y"], again.outputs["y"])


LOOP = "for _ in range(3):\n    x = x + 0.1 * torch.randn(1, 3)\nreturn self.linear(x)"


def test_noise_drawn_at_each_step_is_refused_with_how_to_declare_it(export: Export) -> None:
    with pytest.raises(GraphError, match="draws random numbers, 3 times an inference") as caught:
        export(LOOP)
    assert "noise: {noise: {shape: [3, 1, 3], distribution: normal}}" in caught.value.fix
    assert "noise[i]" in caught.value.fix


def test_noise_of_all_steps_as_an_input_gives_what_torch_gives(export: Export) -> None:
    program = """\
program:
  - graph: main
    feeds: {x: x, noise: noise}
    gives: {y: y}
    noise: {noise: {shape: [3, 1, 3], distribution: normal}}
"""
    body = LOOP.replace("for _ in", "for i in").replace("torch.randn(1, 3)", "noise[i]")
    made = load(export(body, YAML + program, "x, noise").path, threads=1)
    zero = {"x": np.zeros((1, 3), np.float32)}
    noise = np.random.default_rng(0).standard_normal((3, 1, 3)).astype(np.float32)
    moved = made.infer({"x": 0.1 * noise.sum(0)}, noise={"noise": np.zeros_like(noise)})
    np.testing.assert_allclose(made.infer(zero, noise={"noise": noise}).outputs["y"], moved.outputs["y"], atol=1e-6)


def test_each_cause_of_the_table_has_a_remedy_of_its_own() -> None:
    assert len({cause.name for cause in CAUSES}) == len({cause.remedy for cause in CAUSES}) == len(CAUSES)
