"""A program in torch gives what the runtime's interpreter gives, in batches and with gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError
from vlatool.module.batched import BatchedProgram, drawn
from vlatool.module.torch_policy import TorchSession
from vlatool.runtime.program import Program


class Encode(nn.Module):
    def forward(self, x):
        return x * 2


class Denoise(nn.Module):
    def __init__(self, alone: bool = False):
        super().__init__()
        self.mix = nn.Linear(3, 3)
        self.alone = alone

    def forward(self, seen, state, time):
        moved = state + 0.1 * time[:, None] * torch.tanh(self.mix(seen + state))
        return moved.reshape(1, 3) if self.alone else moved


STEPS = (
    ProgramStep("encode", {"x": "x"}, {"y": "seen"}),
    ProgramStep("denoise", {"seen": "seen", "state": "state", "time": "time"}, {"moved": "next"}, repeat=3,
                carry={"next": "state"}, schedule={"time": [1.0, 0.5, 0.25]},
                noise={"state": {"shape": [1, 3]}}),
)  # fmt: skip


@pytest.mark.parametrize("alone", [False, True])
def test_it_is_the_runtimes_program(alone: bool):
    torch.manual_seed(0)
    modules = {"encode": Encode().eval(), "denoise": Denoise(alone).eval()}
    batched = BatchedProgram(STEPS, modules)
    random = np.random.default_rng(0)
    x = random.standard_normal((4, 3)).astype(np.float32)
    noise = drawn(batched.noise, 4, random)
    ours = batched.run({"x": torch.from_numpy(x)}, noise)["next"]
    for row in range(4):
        sessions = {step.graph: TorchSession(modules[step.graph], step) for step in STEPS}
        given = {"state": noise["state"][row : row + 1].numpy()}
        wanted = Program(STEPS, sessions).run({"x": x[row : row + 1]}, given)["next"]
        np.testing.assert_allclose(ours[row : row + 1].detach().numpy(), wanted, rtol=1e-5, atol=1e-6)
    (slope,) = torch.autograd.grad(ours.sum(), [modules["denoise"].mix.bias])
    assert float(slope.abs().sum()) > 0


def test_a_module_that_fails_is_named():
    modules = {"encode": Encode(), "denoise": Denoise()}
    with pytest.raises(
        SourceError, match=r"fails on an observation that fits its spec: RuntimeError.*given seen \[1, 5\]"
    ):
        BatchedProgram(STEPS, modules).run({"x": torch.ones(2, 5)}, {"state": torch.ones(2, 3)})


def test_noise_is_drawn_as_declared():
    wanted = {"a": {"shape": [1, 500]}, "b": {"shape": [1, 500], "distribution": "uniform"},
              "c": {"shape": [1, 2], "distribution": "zeros"}}  # fmt: skip
    found = drawn(wanted, 4, np.random.default_rng(0))
    assert found["a"].shape == (4, 500)
    assert float(found["a"].std()) == pytest.approx(1.0, abs=0.1)
    assert float(found["b"].abs().max()) <= 1.0
    assert not bool(found["c"].any())
    again = drawn(wanted, 4, np.random.default_rng(0))
    assert torch.equal(found["a"], again["a"])
