"""Weights depend on the seed and the parameter's name, and on nothing else."""

from __future__ import annotations

import math

import torch
from torch import nn

from vlatool.samples import resnet18
from vlatool.samples._build import build
from vlatool.samples._language import Causal, DecoderLayer, DecoderShape, Prefill, Rotary
from vlatool.samples._vision import VisionFeatures, VisionShape

SMALL = DecoderShape(width=32, layers=2, heads=4, shared_heads=2, head_width=8, hidden=48)
EYE = VisionShape(32, 16, 24, 1, 2, 48, registers=2, gains=True)


def tensors(module: nn.Module) -> dict[str, torch.Tensor]:
    return {**dict(module.named_parameters()), **dict(module.named_buffers())}


def same(one: nn.Module, other: nn.Module) -> bool:
    left, right = tensors(one), tensors(other)
    return left.keys() == right.keys() and all(torch.equal(left[name], right[name]) for name in left)


def test_a_seed_gives_the_same_weights_whatever_the_global_random_state() -> None:
    torch.manual_seed(1)
    first = resnet18.make(seed=3)
    torch.manual_seed(2)
    assert same(first, resnet18.make(seed=3))


def test_another_seed_gives_other_weights() -> None:
    first, second = (build(lambda: Prefill(SMALL, 5), seed) for seed in (0, 1))
    assert not torch.equal(first.decoder.layers[0].query.weight, second.decoder.layers[0].query.weight)


def test_the_global_random_state_is_left_alone() -> None:
    before = torch.get_rng_state()
    build(lambda: VisionFeatures(EYE, 10), seed=0)
    assert torch.equal(before, torch.get_rng_state())


def test_every_tensor_gets_a_finite_value() -> None:
    for module in (build(lambda: VisionFeatures(EYE, 10), 0), resnet18.make(), build(lambda: Prefill(SMALL, 5), 0)):
        assert all(torch.isfinite(tensor).all() for tensor in tensors(module).values())


def test_matrices_are_scaled_by_their_fan_in_and_scales_are_about_one() -> None:
    layer = build(lambda: nn.Sequential(nn.Linear(400, 300), nn.LayerNorm(300)), 0)
    assert abs(layer[0].weight.std().item() * math.sqrt(400) - 1) < 0.02
    assert abs(layer[1].weight.mean().item() - 1) < 0.01
    assert abs(layer[1].bias.mean().item()) < 0.01


def test_a_part_alone_has_the_weights_that_it_has_in_the_whole() -> None:
    whole = build(lambda: Prefill(SMALL, 5), seed=4)
    part = build(lambda: DecoderLayer(SMALL), seed=4, prefix="decoder.layers.1")
    assert same(part, whole.decoder.layers[1])


def test_half_precision_weights_are_the_rounded_full_ones() -> None:
    full, half = (build(lambda: DecoderLayer(SMALL), 0, dtype) for dtype in ("float32", "float16"))
    assert torch.equal(full.query.weight.half(), half.query.weight)


def test_constants_are_exact() -> None:
    causal = build(lambda: Causal(3), 0)
    assert causal().tolist() == [[0, -1e4, -1e4], [0, 0, -1e4], [0, 0, 0]]
    rotary = build(lambda: Rotary(4, 2, 10000.0), 0)
    cosines, sines = rotary(torch.tensor([[3]]))
    assert torch.allclose(cosines, torch.full((1, 1, 1, 2), math.cos(3)))
    assert torch.allclose(sines, torch.full((1, 1, 1, 2), math.sin(3)))


def test_pixels_are_normalised_inside() -> None:
    module = build(lambda: VisionFeatures(EYE, 10), 0)
    image = torch.tensor([0, 128, 255], dtype=torch.uint8).expand(1, 1, 1, 3)
    wanted = [(0 - 0.485) / 0.229, (128 / 255 - 0.456) / 0.224, (1 - 0.406) / 0.225]
    assert torch.allclose(module.encoder.pixels(image).flatten(), torch.tensor(wanted), atol=1e-5)
