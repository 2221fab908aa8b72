"""The multi-graph policies compute what one undivided forward pass would; padding changes nothing."""

from __future__ import annotations

import pytest
import torch

from vlatool.samples._blocks import sinusoid
from vlatool.samples._build import build
from vlatool.samples._expert import ActionExpert, ExpertShape
from vlatool.samples._fusion import FusionPolicy, FusionShape
from vlatool.samples._language import DecoderShape, Prefill
from vlatool.samples._openvla import OpenDecode, OpenPrefill, OpenShape
from vlatool.samples._smolvla import Prefix, SmolShape, Step
from vlatool.samples._vision import VisionShape

LANGUAGE = DecoderShape(width=32, layers=3, heads=4, shared_heads=2, head_width=8, hidden=48)
SMOL = SmolShape(
    vision=VisionShape(64, 8, 24, 1, 2, 48, registers=0),
    language=LANGUAGE,
    expert_width=16,
    expert_hidden=24,
    vocabulary=50,
    words=6,
    state=5,
    chunk=7,
    action=4,
)
OPEN = OpenShape(
    first=VisionShape(32, 8, 16, 1, 2, 32, registers=3, gains=True),
    second=VisionShape(32, 8, 24, 1, 2, 32, registers=0),
    language=LANGUAGE,
    vocabulary=120,
    rows=128,
    bins=64,
    words=5,
)


def image(size: int) -> torch.Tensor:
    return torch.randint(0, 256, (1, size, size, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


def greedy(prefill: OpenPrefill, ids: torch.Tensor) -> list[int]:
    """Decode without a cache: all tokens pass the decoder again for each new one."""
    language, seen = prefill.language, prefill.eyes(image(32))
    chosen: list[int] = []
    while len(chosen) < OPEN.action:
        words = torch.cat([ids[ids != 0][None], torch.tensor([chosen], dtype=torch.int64)], dim=1)
        tokens = torch.cat([seen, language.words(words)], dim=1)
        length = tokens.shape[1]
        mask = torch.full((length, length), -1e4).triu(1)
        hidden, _, _ = language.decoder(tokens, language.decoder.rotary.first(length), mask)
        chosen.append(int(language.choose(hidden[:, -1:])))
    return chosen


@torch.no_grad()
@pytest.mark.parametrize("ids", [[[7, 8, 9, 3, 4]], [[7, 8, 0, 0, 0]], [[0, 0, 0, 0, 0]]])
def test_cached_decoding_chooses_the_tokens_of_decoding_without_a_cache(ids: list[list[int]]) -> None:
    prefill = build(lambda: OpenPrefill(OPEN), seed=1)
    decode = OpenDecode(OPEN, prefill.language).eval()
    tokens, keys, values, mask = prefill(image(32), torch.tensor(ids))
    action = torch.empty(0)
    for position in range(OPEN.action - 1):
        action, tokens, keys, values = decode(tokens, torch.tensor([position]), keys, values, mask)
    wanted = greedy(prefill, torch.tensor(ids))
    assert tokens.tolist() == [wanted]
    assert all(OPEN.vocabulary - OPEN.bins <= token < OPEN.vocabulary for token in wanted)
    edges = torch.linspace(-1, 1, OPEN.bins)
    centres = (edges[:-1] + edges[1:]) / 2
    bins = (OPEN.vocabulary - torch.tensor([[wanted]]) - 1).clamp(0, OPEN.bins - 2)
    assert torch.allclose(action, centres[bins], atol=1e-6)


@torch.no_grad()
def test_smolvla_like_ignores_padding() -> None:
    prefix, step = build(lambda: Prefix(SMOL), 0), build(lambda: Step(SMOL), 1)
    ids, noise = torch.tensor([[5, 6, 7, 0, 0, 0]]), torch.full((1, SMOL.chunk, SMOL.action), 0.3)
    results = []
    for _ in range(2):
        keys, values, mask = prefix(image(64), ids, torch.ones(1, SMOL.state))
        results.append(step(noise, torch.tensor([0.5]), keys, values, mask))
        prefix.words.weight[0] += 3.0
    assert mask.sum() == SMOL.prefix - 3
    assert torch.allclose(results[0], results[1], atol=1e-6)
    assert not torch.allclose(results[0], noise)


@torch.no_grad()
def test_smolvla_like_hides_the_state_from_image_and_words() -> None:
    prefix = build(lambda: Prefix(SMOL), 0)
    ids = torch.tensor([[5, 6, 7, 8, 0, 0]])
    one, other = (prefix(image(64), ids, torch.full((1, SMOL.state), fill))[0] for fill in (0.0, 1.0))
    assert torch.equal(one[..., :-1, :], other[..., :-1, :])
    assert not torch.equal(one[..., -1, :], other[..., -1, :])


@torch.no_grad()
def test_smolvla_like_actions_see_only_earlier_actions() -> None:
    step = build(lambda: Step(SMOL), 0)
    cache = torch.ones(1, LANGUAGE.layers, LANGUAGE.shared_heads, SMOL.prefix, LANGUAGE.head_width)
    mask, noise = torch.ones(1, SMOL.prefix, dtype=torch.bool), torch.zeros(1, SMOL.chunk, SMOL.action)
    other = noise.clone()
    other[:, -1] = 1.0
    one, two = (step(x, torch.tensor([1.0]), cache, cache, mask) for x in (noise, other))
    assert torch.allclose(one[:, :-1], two[:, :-1], atol=1e-6)
    assert not torch.allclose(one[:, -1] - two[:, -1], torch.tensor(-1.0), atol=1e-3)


@torch.no_grad()
def test_prefill_is_causal() -> None:
    module = build(lambda: Prefill(LANGUAGE, 6), 0)
    one = torch.randn(1, 6, 32, generator=torch.Generator().manual_seed(1))
    other = one.clone()
    other[:, 4:] = 0
    assert torch.allclose(module(one)[:, :4], module(other)[:, :4], atol=1e-6)


@torch.no_grad()
def test_fusion_ignores_padding_and_tells_the_cameras_apart() -> None:
    shape = FusionShape(vision=VisionShape(32, 16, 24, 1, 2, 48), words=4, vocabulary=20, depth=1, chunk=3, action=2)
    policy = build(lambda: FusionPolicy(shape), 0)
    front, wrist, ids = image(32), image(32).flip(1), torch.tensor([[3, 4, 0, 0]])
    plain, swapped = policy(front, wrist, ids), policy(wrist, front, ids)
    policy.words.weight[0] += 3.0
    assert plain.shape == (1, 3, 2)
    assert torch.allclose(plain, policy(front, wrist, ids), atol=1e-6)
    assert not torch.allclose(plain, swapped, atol=1e-3)


@torch.no_grad()
def test_expert_depends_on_each_input() -> None:
    shape = ExpertShape(width=16, depth=1, heads=2, hidden=24, context=8, chunk=3, action=2)
    expert = build(lambda: ActionExpert(shape), 0)
    inputs = [torch.zeros(1, 3, 2), torch.tensor([0.5]), torch.ones(1, 4, 8)]
    plain = expert(*inputs)
    for index in range(3):
        changed = [tensor + 0.4 if index == position else tensor for position, tensor in enumerate(inputs)]
        assert not torch.allclose(plain, expert(*changed), atol=1e-4)


def test_sinusoid_spans_the_periods() -> None:
    embedded = sinusoid(torch.tensor([0.25]), 4, shortest=0.5, longest=1.0)
    assert torch.allclose(embedded, torch.tensor([[0.0, 1.0, -1.0, 0.0]]), atol=1e-6)
