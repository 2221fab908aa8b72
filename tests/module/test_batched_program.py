"""A program in torch gives what the runtime's interpreter gives, in batches and with gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError
from vlatool.module.batched_program import BatchedProgram, draw_noise
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
    noise = draw_noise(batched.noise, 4, random)
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
    found = draw_noise(wanted, 4, np.random.default_rng(0))
    assert found["a"].shape == (4, 500)
    assert float(found["a"].std()) == pytest.approx(1.0, abs=0.1)
    assert float(found["b"].abs().max()) <= 1.0
    assert not bool(found["c"].any())
    again = draw_noise(wanted, 4, np.random.default_rng(0))
    assert torch.equal(found["a"], again["a"])


class Gru(nn.Module):
    def __init__(self, of_batch: str = ""):
        super().__init__()
        self.gru, self.of_batch = nn.GRU(3, 4, num_layers=2), of_batch

    def forward(self, x, memory, count):
        if self.of_batch == "first":
            memory = memory[:, :1].expand(-1, len(x), -1)
        seen, memory = self.gru(x[None], memory.contiguous())
        return seen[0], memory, count + 1


def kept_steps(shape: list[int]) -> tuple[ProgramStep, ...]:
    keep = {"memory": {"shape": shape}, "count": {"shape": [1, 1], "dtype": "int64"}}
    return (
        ProgramStep(
            "main",
            {"x": "x", "memory": "memory", "count": "count"},
            {"y": "y", "m": "memory", "c": "count"},
            keep=keep,
        ),
    )


@pytest.mark.parametrize("of_batch", ["", "first"])
def test_what_is_kept_goes_from_run_to_run_as_in_the_runtime(of_batch: str):
    """With the batch in the axis that modules take; where rows would mix, row by row."""
    torch.manual_seed(0)
    steps, module = kept_steps([2, 1, 4]), Gru(of_batch).eval()
    batched = BatchedProgram(steps, {"main": module})
    x = np.random.default_rng(0).standard_normal((5, 3, 3)).astype(np.float32)
    kept, ours = {}, []
    for now in x:
        values = batched.run({"x": torch.from_numpy(now)}, kept)
        kept = batched.kept_of(values)
        ours.append(values["y"])
    assert batched.runs_at_once(3) == (not of_batch)
    assert kept["memory"].shape == (3, 2, 1, 4)
    assert kept["count"].reshape(-1).tolist() == [5, 5, 5]
    for row in range(3):
        program = Program(steps, {"main": TorchSession(module, steps[0])})
        wanted = [program.run({"x": now[row : row + 1]})["y"] for now in x]
        for got, want in zip(ours, wanted, strict=True):
            np.testing.assert_allclose(got[row : row + 1].detach().numpy(), want, rtol=1e-5, atol=1e-6)
    (slope,) = torch.autograd.grad(ours[-1].sum(), [module.gru.weight_ih_l0])
    assert float(slope.abs().sum()) > 0


def test_a_kept_value_of_another_shape_is_named():
    batched = BatchedProgram(kept_steps([2, 1, 4]), {"main": lambda x, memory, count: (x, memory[:1], count)})
    with pytest.raises(SourceError, match=r"kept value 'memory' is \[1, 1, 4\]; the program declares \[2, 1, 4\]"):
        batched.run({"x": torch.ones(1, 3)}, {})


def test_what_a_training_mixes_with_bfloat16_has_a_remedy_of_its_own():
    """A kept window in float32 does not take what a product in bfloat16 gives."""
    layer = nn.Linear(3, 3)
    steps = (ProgramStep("main", {"x": "x", "w": "w"}, {"y": "y", "n": "w"}, keep={"w": {"shape": [1, 2, 3]}}),)

    def scattered(x, window):
        window = window.scatter(1, torch.zeros(len(x), 1, 3, dtype=torch.int64), layer(x)[:, None])
        return window.sum(1), window

    batched = BatchedProgram(steps, {"main": scattered})
    assert batched.run({"x": torch.ones(1, 3)}, {})["y"].shape == (1, 3)
    with torch.autocast("cpu", torch.bfloat16), pytest.raises(SourceError, match="dtype") as caught:
        batched.run({"x": torch.ones(1, 3)}, {})
    assert caught.value.fix == "train in float32: --precision float32"


@pytest.mark.parametrize("dtype", ["float16", "float64", "int64", "bool"])
@pytest.mark.parametrize("rows", [1, 2])
def test_values_of_any_dtype_are_kept_while_a_training_casts(dtype: str, rows: int):
    """Autocast itself knows no float16 on a processor, which is no matter of what is kept."""
    layer = nn.Linear(3, 3)
    keep = {"w": {"shape": [1, 3], "dtype": dtype}}
    steps = (ProgramStep("main", {"x": "x", "w": "w"}, {"y": "y", "n": "w"}, keep=keep),)

    def forward(x, kept):
        assert len(x) == 1, "takes no batch"
        return layer(x + kept.float()), (kept.float() + x).to(kept.dtype)

    batched, kept = BatchedProgram(steps, {"main": forward}), {}
    with torch.autocast("cpu", torch.bfloat16):
        for _ in range(3):
            kept = batched.kept_of(batched.run({"x": torch.ones(rows, 3)}, kept))
    assert kept["w"].dtype == getattr(torch, dtype)
    assert kept["w"].float().unique().tolist() == [1.0 if dtype == "bool" else 3.0]
