"""What blocks give, in batches, row by row and in loops: the same rows in the same order."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.training.taps import Form, Taps


class Block(nn.Module):
    def __init__(self, kind: str):
        super().__init__()
        self.linear = nn.Conv2d(3, 3, 1) if kind == "map" else nn.Linear(3, 3)
        self.kind = kind

    def forward(self, x):
        x = x + torch.tanh(self.linear(x))
        return {"tuple": (x, None), "words": {"x": x}}.get(self.kind, x)


class Net(nn.Module):
    """Tokens (B, 5, 3) through two blocks; ``alone`` takes one row at a time."""

    def __init__(self, kind: str = "plain", alone: bool = False):
        super().__init__()
        torch.manual_seed(0)
        self.blocks = nn.ModuleList(Block(kind) for _ in range(2))
        self.kind, self.alone = kind, alone

    def forward(self, x, state):
        y = x + state
        if self.kind == "map":
            y = y.transpose(1, 2).reshape(-1, 3, 5, 1)
        for block in self.blocks:
            gives = block(y)
            y = gives[0] if isinstance(gives, tuple) else gives["x"] if isinstance(gives, dict) else gives
        y = y.flatten(2).transpose(1, 2) if self.kind == "map" else y
        return y.reshape(1, 5, 3) if self.alone else y


PLACES = [("main", "blocks.0"), ("main", "blocks.1")]


def taps(repeat: int = 1, **options) -> tuple[Taps, dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    step = ProgramStep("main", {"x": "x", "state": "state"}, {"y": "next"}, repeat=repeat, carry={"next": "state"},
                       noise={"state": {"shape": [1, 5, 3]}})  # fmt: skip
    program = BatchedProgram([step], {"main": Net(**options).eval()})
    random = np.random.default_rng(0)
    x = torch.from_numpy(random.standard_normal((4, 5, 3)).astype(np.float32))
    return Taps(program, PLACES), {"x": x}, draw_noise(program.noise, 4, random)


def rows(values: dict[str, torch.Tensor], start: int, end: int) -> dict[str, torch.Tensor]:
    return {name: value[start:end] for name, value in values.items()}


@pytest.mark.parametrize("repeat", [1, 3])
@pytest.mark.parametrize("kind", ["plain", "tuple", "map"])
def test_batches_give_what_single_rows_give(kind: str, repeat: int):
    taken = []
    for alone in (False, True):
        tap, inputs, noise = taps(repeat, kind=kind, alone=alone)
        tap.program.look(inputs, noise)
        assert tap.program.runs_at_once(4) is not alone
        forms = tap.forms(rows(inputs, 0, 1), rows(noise, 0, 1))
        assert {form.calls for form in forms.values()} == {repeat}
        with tap.open(4):
            tap.program.run(inputs, noise)
        taken.append(tap.take(4))
        assert not tap.take(4), "what was taken is gone"
    assert list(taken[0]) == PLACES
    shape = (4 * repeat, 5, 1, 3) if kind == "map" else (4 * repeat, 5, 3)
    for place in PLACES:
        assert taken[0][place].shape == shape, "features are last"
        torch.testing.assert_close(taken[0][place], taken[1][place], rtol=1e-5, atol=1e-6)
        single, ones, drawn_once = taps(repeat, kind=kind)
        single.forms(rows(ones, 0, 1), rows(drawn_once, 0, 1))
        with single.open(1):
            single.program.run(rows(ones, 2, 3), rows(drawn_once, 2, 3))
        torch.testing.assert_close(single.take(1)[place], taken[0][place][2 * repeat : 3 * repeat])


def test_gradients_flow_and_nothing_is_kept_outside():
    tap, inputs, noise = taps()
    tap.program.look(inputs, noise)
    with tap.open(4):
        tap.program.run(inputs, noise)
    tap.take(4)[PLACES[0]].sum().backward()
    assert tap.program.modules["main"].blocks[0].linear.weight.grad is not None
    assert tap.program.modules["main"].blocks[1].linear.weight.grad is None
    tap.program.run(inputs, noise)
    assert tap.take(4) == {}


def test_forms_say_what_cannot_be_compared():
    tap, inputs, noise = taps(2, kind="words")
    forms = tap.forms(rows(inputs, 0, 1), rows(noise, 0, 1))
    assert set(forms.values()) == {Form(2)}
    assert Form(1, (1, 8, 4, 5), channels_first=True).features == (1, 4, 5, 8)
    assert Form(1, (1, 8, 4)).features == (1, 8, 4)
