"""Weights that are cut or turned in the graph become weights of their own, with the same actions."""

from collections import Counter

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.graph.layers import find_layers
from vlatool.module.folding import fold_weights
from vlatool.module.to_onnx import exported_by_torch

STEP = ProgramStep("main", {"x": "x", "context": "context"}, {"y": "y"})


class Attends(nn.Module):
    """Attention over a context: torch cuts its projections out of one weight and one bias."""

    def __init__(self) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(32, 4, batch_first=True)

    def forward(self, x, context):
        return self.attention(x, context, context, need_weights=False)[0]


class Cuts(nn.Module):
    """One weight in three unequal parts, one of which is used twice, and one that is turned as it is read."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.linspace(-1, 1, 32 * 24).reshape(24, 32))
        self.other = nn.Parameter(torch.linspace(-1, 1, 32 * 32).reshape(32, 32))

    def forward(self, x, context):
        first, second, third = self.weight.split([4, 8, 12])
        narrow = torch.cat([x @ first.T, x @ second.T, x @ third.T, context[:, :3] @ second.T], -1)
        return narrow @ self.other.T[:, :5] + (x @ self.other.T).sum()


class Keeps(nn.Module):
    """Activations that are cut and turned."""

    def forward(self, x, context):
        first, second = x.split([8, 24], -1)
        return torch.cat([second, first], -1) @ context.transpose(1, 2)


def exported(module: nn.Module, path, folds: bool):
    torch.manual_seed(0)
    given = torch.randn(1, 3, 32), torch.randn(1, 5, 32)
    program = exported_by_torch(module.eval(), given, STEP, 20)
    gone = fold_weights(program.model) if folds else 0
    program.save(str(path))
    return gone, [tensor.numpy() for tensor in given]


def computed_weights(path) -> int:
    """Count the products of which no operand is an activation and none a stored weight."""
    model = onnx.load(path)
    stored = {each.name for each in model.graph.initializer}
    made = {name for node in model.graph.node if node.op_type in ("Split", "Transpose") and node.input[0] in stored
            for name in node.output}  # fmt: skip
    return sum(not made.isdisjoint(node.input) for node in model.graph.node)


@pytest.mark.parametrize("module", [Attends, Cuts])
def test_products_hold_their_weights_and_give_the_same(module, tmp_path):
    torch.manual_seed(1)
    policy = module()
    plain, folded = tmp_path / "plain.onnx", tmp_path / "folded.onnx"
    exported(policy, plain, folds=False)
    gone, given = exported(policy, folded, folds=True)
    assert gone >= 2
    assert computed_weights(plain) > 0
    assert computed_weights(folded) == 0
    onnx.checker.check_model(str(folded), full_check=True)
    feeds = dict(zip(("x", "context"), given, strict=True))
    plain_y, folded_y = (
        onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(None, feeds)[0]
        for path in (plain, folded)
    )
    np.testing.assert_array_equal(folded_y, plain_y)
    with torch.no_grad():
        np.testing.assert_allclose(folded_y, policy(*map(torch.from_numpy, given)).numpy(), rtol=1e-4, atol=1e-4)


def test_no_weight_is_stored_twice(tmp_path):
    exported(Attends(), tmp_path / "a.onnx", folds=True)
    sizes = Counter(tuple(each.dims) for each in onnx.load(tmp_path / "a.onnx").graph.initializer)
    assert (96, 32) not in sizes
    assert sum(np.prod(dims) * number for dims, number in sizes.items() if len(dims) == 2) == 4 * 32 * 32


def test_every_projection_of_an_attention_over_a_context_is_a_layer(tmp_path):
    found = {}
    for folds in (False, True):
        exported(Attends(), tmp_path / "a.onnx", folds=folds)
        found[folds] = len(find_layers(onnx.load(tmp_path / "a.onnx"), ("MatMul", "Gemm")))
    assert found == {False: 1, True: 3}, "the query's, the key's and value's, and the output's"


def test_what_is_no_weight_stays(tmp_path):
    gone, _ = exported(Keeps(), tmp_path / "k.onnx", folds=True)
    assert gone == 0
