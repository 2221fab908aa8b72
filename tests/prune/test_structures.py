"""Structured pruning of well-known networks whose parts are concatenated, split or sliced: they reach what is asked."""

from __future__ import annotations

import math

import pytest
import torch
from _pruned import check_pruned
from torch import Tensor, nn
from torch.nn import functional


class StepEmbedding(nn.Module):
    """Sines and cosines of a step of the diffusion."""

    def __init__(self, width: int):
        super().__init__()
        self.width = width

    def forward(self, step: Tensor) -> Tensor:
        half = self.width // 2
        angles = step[:, None] * torch.exp(torch.arange(half) * -(math.log(10000) / (half - 1)))[None]
        return torch.cat((angles.sin(), angles.cos()), -1)


def convolved(given: int, out: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv1d(given, out, 5, padding=2), nn.GroupNorm(8, out), nn.Mish())


class ConditionalBlock(nn.Module):
    """Two convolutions with FiLM between them, and a residual: the block of Diffusion Policy's U-Net."""

    def __init__(self, given: int, out: int, condition: int):
        super().__init__()
        self.out = out
        self.blocks = nn.ModuleList([convolved(given, out), convolved(out, out)])
        self.condition = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * out), nn.Unflatten(-1, (-1, 1)))
        self.residual = nn.Conv1d(given, out, 1) if given != out else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, bias = self.condition(condition).reshape(len(x), 2, self.out, 1).unbind(1)
        return self.blocks[1](scale * self.blocks[0](x) + bias) + self.residual(x)


class ConditionalUnet1D(nn.Module):
    """The U-Net over time of Diffusion Policy (Chi et al., arXiv 2303.04137), narrow."""

    def __init__(self, action: int = 4, state: int = 10, step: int = 16, widths: tuple[int, ...] = (16, 32, 48)):
        super().__init__()
        self.step = nn.Sequential(StepEmbedding(step), nn.Linear(step, 4 * step), nn.Mish(), nn.Linear(4 * step, step))
        pairs, condition = list(zip((action, *widths), widths, strict=False)), step + state
        self.down = nn.ModuleList(nn.ModuleList([
            ConditionalBlock(given, out, condition), ConditionalBlock(out, out, condition),
            nn.Conv1d(out, out, 3, 2, 1) if out != widths[-1] else nn.Identity(),
        ]) for given, out in pairs)  # fmt: skip
        self.mid = nn.ModuleList(ConditionalBlock(widths[-1], widths[-1], condition) for _ in range(2))
        self.up = nn.ModuleList(nn.ModuleList([
            ConditionalBlock(2 * out, given, condition), ConditionalBlock(given, given, condition),
            nn.ConvTranspose1d(given, given, 4, 2, 1),
        ]) for given, out in reversed(pairs[1:]))  # fmt: skip
        self.final = nn.Sequential(convolved(widths[0], widths[0]), nn.Conv1d(widths[0], action, 1))

    def forward(self, noisy: Tensor, step: Tensor, state: Tensor) -> Tensor:
        x, condition, skips = noisy.transpose(1, 2), torch.cat([self.step(step), state], -1), list[Tensor]()
        for first, second, smaller in self.down:
            x = second(first(x, condition), condition)
            skips.append(x)
            x = smaller(x)
        for block in self.mid:
            x = block(x, condition)
        for first, second, larger in self.up:
            x = larger(second(first(torch.cat((x, skips.pop()), 1), condition), condition))
        return self.final(x).transpose(1, 2)


def test_the_u_net_of_diffusion_policy_reaches_the_ratio():
    torch.manual_seed(0)
    feeds = [torch.randn(1, 8, 4), torch.tensor([5.0]), torch.randn(1, 10)]
    record = check_pruned(ConditionalUnet1D(), feeds, "U-Net", "magnitude")
    assert record["reached"] >= 0.9 * 0.3
    assert record["without_rule"] == []


class UNet(nn.Module):
    """Two levels over an image, joined by concatenation."""

    def __init__(self):
        super().__init__()
        self.first, self.second, self.third = conv(3, 8), conv(8, 16), conv(16, 24)
        self.up, self.wide = nn.ConvTranspose2d(24, 16, 2, 2), nn.Upsample(scale_factor=2, mode="bilinear")
        self.fourth, self.fifth, self.last = conv(32, 16), conv(24, 8), nn.Conv2d(8, 2, 1)

    def forward(self, image: Tensor) -> Tensor:
        large = self.first(image)
        small = self.second(functional.max_pool2d(large, 2))
        x = self.up(self.third(functional.max_pool2d(small, 2)))
        x = self.fourth(torch.cat([x, small], 1))
        return self.last(self.fifth(torch.cat([self.wide(x), large], 1)))


def conv(given: int, out: int, size: int = 3) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(given, out, size, padding=size // 2), nn.BatchNorm2d(out), nn.ReLU())


class Inception(nn.Module):
    """Branches of different kernels side by side."""

    def __init__(self):
        super().__init__()
        self.stem, self.one, self.three = conv(3, 12), conv(12, 6, 1), nn.Sequential(conv(12, 4, 1), conv(4, 8))
        self.pooled, self.next, self.head = conv(12, 5, 1), conv(19, 16), nn.Linear(16, 4)

    def forward(self, image: Tensor) -> Tensor:
        x = self.stem(image)
        x = torch.cat([self.one(x), self.three(x), self.pooled(functional.max_pool2d(x, 3, 1, 1))], 1)
        return self.head(self.next(x).mean((2, 3)))


class DenseNet(nn.Module):
    """Each layer reads what all before it gave."""

    def __init__(self, growth: int = 6):
        super().__init__()
        self.stem, widths = nn.Conv2d(3, 8, 3, padding=1), [8 + growth * number for number in range(4)]
        self.layers = nn.ModuleList(
            nn.Sequential(nn.BatchNorm2d(width), nn.ReLU(), conv(width, 12, 1), nn.Conv2d(12, growth, 3, padding=1))
            for width in widths[:-1]
        )
        self.transition, self.head = conv(widths[-1], 12, 1), nn.Linear(12, 4)

    def forward(self, image: Tensor) -> Tensor:
        x = self.stem(image)
        for layer in self.layers:
            x = torch.cat([x, layer(x)], 1)
        return self.head(self.transition(x).mean((2, 3)))


class PointNet(nn.Module):
    """Features of each point beside those of the cloud."""

    def __init__(self):
        super().__init__()
        self.local, self.whole = nn.Conv1d(3, 12, 1), nn.Conv1d(12, 24, 1)
        self.joint, self.last = nn.Conv1d(36, 16, 1), nn.Conv1d(16, 2, 1)

    def forward(self, points: Tensor) -> Tensor:
        local = self.local(points).relu()
        whole = self.whole(local).amax(2, keepdim=True).expand(-1, -1, points.shape[2])
        return self.last(self.joint(torch.cat([local, whole], 1)).relu())


class ConvGru(nn.Module):
    """Gates by chunk, of a concatenation with the state."""

    def __init__(self):
        super().__init__()
        self.stem, self.gates, self.new = conv(3, 6), nn.Conv2d(14, 16, 3, padding=1), nn.Conv2d(14, 8, 3, padding=1)
        self.head = nn.Linear(8, 3)

    def forward(self, image: Tensor) -> Tensor:
        x, state = self.stem(image), torch.zeros(len(image), 8, *image.shape[2:])
        for _ in range(2):
            update, reset = torch.sigmoid(self.gates(torch.cat([x, state], 1))).chunk(2, 1)
            state = (1 - update) * state + update * torch.tanh(self.new(torch.cat([x, reset * state], 1)))
        return self.head(state.mean((2, 3)))


class Lstm(nn.Module):
    """Four gates by chunk."""

    def __init__(self):
        super().__init__()
        self.given, self.kept, self.head = nn.Linear(5, 48), nn.Linear(12, 48), nn.Linear(12, 3)

    def forward(self, x: Tensor) -> Tensor:
        state = memory = torch.zeros(len(x), 12)
        for step in range(2):
            one, two, three, four = (self.given(x[:, step]) + self.kept(state)).chunk(4, 1)
            memory = torch.sigmoid(two) * memory + torch.sigmoid(one) * torch.tanh(three)
            state = torch.sigmoid(four) * torch.tanh(memory)
        return self.head(state)


class SharedKeys(nn.Module):
    """Queries, keys and values from one projection, in parts of different sizes; a gated layer beside the attention."""

    def __init__(self):
        super().__init__()
        self.first, self.joint = nn.Linear(5, 16), nn.Linear(16, 6 * 4 + 2 * 2 * 4 + 20 + 20)
        self.out, self.head = nn.Linear(24 + 20, 16), nn.Linear(16, 3)

    def forward(self, x: Tensor) -> Tensor:
        x = self.first(x)
        query, key, value, gate, up = self.joint(x).split([24, 8, 8, 20, 20], -1)
        query, key, value = (each.unflatten(-1, (-1, 4)).transpose(1, 2) for each in (query, key, value))
        mixed = functional.scaled_dot_product_attention(query, key, value, enable_gqa=True).transpose(1, 2).flatten(2)
        return self.head(x + self.out(torch.cat([mixed, functional.silu(gate) * up], -1)))


@pytest.mark.parametrize(("make", "shape"), [
    (UNet, (1, 3, 8, 8)), (Inception, (1, 3, 6, 6)), (DenseNet, (1, 3, 6, 6)), (PointNet, (1, 3, 7)),
    (ConvGru, (1, 3, 5, 5)), (Lstm, (1, 2, 5)), (SharedKeys, (1, 4, 5)),
])  # fmt: skip
def test_networks_of_concatenated_and_divided_parts_reach_the_ratio(make: type[nn.Module], shape: tuple[int, ...]):
    torch.manual_seed(0)
    record = check_pruned(make(), [torch.randn(shape)], make.__name__)
    assert record["reached"] >= 0.9 * 0.3
    assert record["without_rule"] == []
