"""Recurrent layers of torch as their products and gates, so that each product can be computed in its own way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor

Linear = Callable[..., Any]
"""``torch.nn.functional.linear``, or what stands for it."""


def gru_cell(linear: Linear, given: Tensor, state: Tensor, *weights: Any) -> Tensor:
    """Return the state after a step of ``torch.nn.GRUCell``: (..., H).

    Args:
        linear: computes the products.
        given: (..., I).
        state: (..., H).
        weights: those of the input (3 H, I), of the state (3 H, H), and their biases (3 H), None or left out for none.
    """
    read, write, new = _products(linear, given, weights, 0).chunk(3, -1)
    read_state, write_state, new_state = _products(linear, state, weights, 1).chunk(3, -1)
    keep = (write + write_state).sigmoid()
    proposed = (new + (read + read_state).sigmoid() * new_state).tanh()
    return proposed + keep * (state - proposed)


def lstm_cell(linear: Linear, given: Tensor, states: Sequence[Tensor], *weights: Any) -> tuple[Tensor, Tensor]:
    """Return output and cell after a step of ``torch.nn.LSTMCell``, (..., H) each; arguments as of ``gru_cell``."""
    gates = _products(linear, given, weights, 0) + _products(linear, states[0], weights, 1)
    enter, forget, new, leave = gates.chunk(4, -1)
    cell = forget.sigmoid() * states[1] + enter.sigmoid() * new.tanh()
    return leave.sigmoid() * cell.tanh(), cell


def rnn_tanh_cell(linear: Linear, given: Tensor, state: Tensor, *weights: Any) -> Tensor:
    """Return the state after a step of ``torch.nn.RNNCell``; arguments as of ``gru_cell``."""
    return (_products(linear, given, weights, 0) + _products(linear, state, weights, 1)).tanh()


def rnn_relu_cell(linear: Linear, given: Tensor, state: Tensor, *weights: Any) -> Tensor:
    """Return the state after a step of ``torch.nn.RNNCell`` with relu; arguments as of ``gru_cell``."""
    return (_products(linear, given, weights, 0) + _products(linear, state, weights, 1)).relu()


def rnn_tanh(linear: Linear, *arguments: Any) -> tuple[Tensor, Tensor]:
    """Return what ``torch.rnn_tanh`` gives: outputs (T, B, D H), last states (D L, B, H); takes what that takes."""
    return _run_along(linear, "tanh", *arguments)


def rnn_relu(linear: Linear, *arguments: Any) -> tuple[Tensor, Tensor]:
    """Return what ``torch.rnn_relu`` gives, as ``rnn_tanh``."""
    return _run_along(linear, "relu", *arguments)


def _run_along(
    linear: Linear, gate: str, given: Tensor, state: Tensor, params: Sequence[Tensor], biased: bool, layers: int,
    _dropout: float, _train: bool, bidirectional: bool, batch_first: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Run the layers of ``torch.nn.RNN`` along a sequence, in evaluation: nothing is dropped between them."""
    torch, ways, each = require("torch", "build"), 1 + bidirectional, 4 if biased else 2
    values, last = given.movedim(0, 1) if batch_first else given, []
    for layer in range(layers):
        outputs = []
        for way in range(ways):
            number = layer * ways + way
            weights = params[number * each : (number + 1) * each]
            run, held, rows = [], state[number], _products(linear, values, weights, 0)
            for row in rows.flip(0) if way else rows:
                held = getattr(row + _products(linear, held, weights, 1), gate)()
                run.append(held)
            last.append(held)
            outputs.append(torch.stack(run[::-1] if way else run))
        values = torch.cat(outputs, -1)
    return (values.movedim(0, 1) if batch_first else values), torch.stack(last)


def _products(linear: Linear, values: Tensor, weights: Sequence[Any], number: int) -> Tensor:
    """Multiply by the weights of the input (0) or of the state (1), and add their bias."""
    result: Tensor = linear(values, weights[number], weights[number + 2] if len(weights) > number + 2 else None)
    return result
