"""A training rounds what static int8 rounds in the export: every product with a weight, however it is written."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from vlatool.graph.layers import find_layers
from vlatool.module.to_onnx import quiet_exporter
from vlatool.module.torchlib import shared_table
from vlatool.training import recurrent_steps
from vlatool.training.fake_quantization import fake_quantization, in_blocks, per_channel, per_tensor

linear = nn.functional.linear


class Written(nn.Module):
    """A product, written as a function of this module and a sequence (1, 5, 8)."""

    def __init__(self, layer: nn.Module | None, product: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.layer, self.product = layer, product
        self.matrix, self.bias = nn.Parameter(torch.randn(8, 12)), nn.Parameter(torch.randn(12))
        self.wide, self.each = nn.Parameter(torch.randn(12, 8)), nn.Parameter(torch.randn(3, 8, 12))

    def forward(self, sequence: Tensor) -> Tensor:
        return self.product(self, sequence)


def attended(m: Written, x: Tensor) -> Tensor:
    return m.layer(x, x, x)[0]


CASES = {
    "linear": (nn.Linear(8, 4), lambda m, x: m.layer(x)),
    "linear by names": (nn.Linear(8, 4), lambda m, x: linear(weight=m.layer.weight, input=x)),
    "@": (None, lambda m, x: x @ m.matrix),
    "@ by name": (None, lambda m, x: torch.matmul(x, other=m.matrix)),
    "@ transposed": (None, lambda m, x: x @ m.wide.T),
    "@ a part": (None, lambda m, x: x @ m.each[1]),
    "mm": (None, lambda m, x: torch.mm(x[0], m.matrix)),
    "addmm": (None, lambda m, x: torch.addmm(m.bias, x[0], m.matrix)),
    "bmm": (None, lambda m, x: torch.bmm(x.expand(3, 5, 8), m.each)),
    "baddbmm": (None, lambda m, x: torch.baddbmm(m.bias, x.expand(3, 5, 8), m.each)),
    "a weight first": (None, lambda m, x: m.wide @ x.transpose(1, 2)),
    "of activations": (None, lambda m, x: x @ (x.transpose(1, 2) + m.bias[0])),
    "convolution": (nn.Conv1d(8, 3, 3, padding="same"), lambda m, x: m.layer(x.transpose(1, 2))),
    "transposed convolution": (nn.ConvTranspose1d(8, 3, 2), lambda m, x: m.layer(x.transpose(1, 2))),
    "attention": (nn.MultiheadAttention(8, 2, batch_first=True), attended),
    "attention of other keys": (nn.MultiheadAttention(8, 2, batch_first=True), lambda m, x: m.layer(x, -x, -x)[0]),
    "attention of other sizes": (nn.MultiheadAttention(8, 2, kdim=8, vdim=8, batch_first=True), attended),
    "GRUCell": (nn.GRUCell(8, 12), lambda m, x: m.layer(x[0])),
    "LSTMCell": (nn.LSTMCell(8, 12), lambda m, x: m.layer(x[0])[0]),
    "RNNCell": (nn.RNNCell(8, 12, nonlinearity="relu"), lambda m, x: m.layer(x[0])),
    "RNN": (nn.RNN(8, 12, batch_first=True), lambda m, x: m.layer(x)[0]),
    "GRU": (nn.GRU(8, 12), lambda m, x: m.layer(x)[0]),
    "LSTM": (nn.LSTM(8, 12, bidirectional=True), lambda m, x: m.layer(x)[0]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_training_rounds_what_static_int8_rounds(case: str):
    torch.manual_seed(0)
    module, sequence = Written(*CASES[case]).eval(), torch.randn(1, 5, 8)
    with quiet_exporter(), shared_table():
        graph = torch.onnx.export(module, (sequence,), dynamo=True, opset_version=20, verbose=False).model_proto
        traced = torch.export.unflatten(torch.export.export(module, (sequence,)))
    whole, int8 = module(sequence), bool(find_layers(graph, ("MatMul", "Gemm", "Conv")))
    with fake_quantization("int8"):
        given = module(sequence), traced(sequence)
    assert torch.equal(given[0], whole) is not int8
    assert torch.allclose(*given, atol=1e-6)
    if int8:
        given[0].square().sum().backward()
        assert any(value.grad is not None and bool(value.grad.abs().sum()) for value in module.parameters())


def test_both_factors_of_a_matrix_are_on_their_grids():
    sequence, matrix = torch.randn(4, 8), nn.Parameter(torch.randn(8, 12))
    with fake_quantization("int8"):
        given = sequence @ matrix
    assert torch.equal(given, per_tensor(sequence) @ per_channel(matrix.T).T)
    with fake_quantization("int4"):
        assert torch.equal(sequence @ matrix, sequence @ in_blocks(matrix.T).T)


def test_the_state_of_a_cell_is_rounded_too():
    cell, given, state = nn.GRUCell(8, 12), torch.randn(3, 8), torch.randn(3, 12)

    def rounded(values: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return linear(per_tensor(values), per_channel(weight), bias)

    with fake_quantization("int8"):
        after = cell(given, state)
    weights = cell.weight_ih, cell.weight_hh, cell.bias_ih, cell.bias_hh
    assert torch.equal(after, recurrent_steps.gru_cell(rounded, given, state, *weights))


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("kind", "options"), [
    ("GRUCell", {}), ("LSTMCell", {}), ("RNNCell", {}), ("RNNCell", {"nonlinearity": "relu"}),
])  # fmt: skip
@pytest.mark.parametrize("batch", [(), (3,)])
def test_cells_are_what_their_products_give(kind: str, options: dict[str, str], bias: bool, batch: tuple[int, ...]):
    torch.manual_seed(0)
    cell = getattr(nn, kind)(8, 12, bias=bias, **options)
    states = [torch.randn(*batch, 12) for _ in range(2)]
    state, given = (tuple(states) if kind == "LSTMCell" else states[0]), torch.randn(*batch, 8)
    name = {"GRUCell": "gru_cell", "LSTMCell": "lstm_cell"}.get(kind) or f"rnn_{cell.nonlinearity}_cell"
    weights = [cell.weight_ih, cell.weight_hh, *([cell.bias_ih, cell.bias_hh] if bias else [])]
    found = getattr(recurrent_steps, name)(linear, given, state, *weights)
    wanted = cell(given, state)
    if kind != "LSTMCell":
        found, wanted = (found,), (wanted,)
    for one, other in zip(found, wanted, strict=True):
        assert torch.allclose(one, other, rtol=0, atol=1e-6)


@pytest.mark.parametrize("options", [
    {}, {"num_layers": 2, "bidirectional": True}, {"nonlinearity": "relu", "bias": False, "batch_first": True},
])  # fmt: skip
def test_a_recurrent_layer_is_what_its_products_give(options: dict[str, Any]):
    torch.manual_seed(0)
    layer = nn.RNN(8, 12, **options).eval()
    rows = 3 if layer.batch_first else 5
    given, state = torch.randn(3, 5, 8), torch.randn(layer.num_layers * (1 + layer.bidirectional), rows, 12)
    arguments = (layer._flat_weights, layer.bias, layer.num_layers, 0.0, False, layer.bidirectional, layer.batch_first)
    found = getattr(recurrent_steps, f"rnn_{layer.nonlinearity}")(linear, given, state, *arguments)
    for one, other in zip(found, layer(given, state), strict=True):
        assert torch.allclose(one, other, rtol=0, atol=1e-6)
