"""Random torch modules of few layers for structured pruning: every kind of operator that a policy may have."""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import chain

import torch
from torch import Tensor, nn
from torch.nn import functional

Call = Callable[..., Tensor]
SIDE, LENGTH = 8, 6
"""Places of an image along each side, and elements of a sequence."""


class Block(nn.Module):
    """Some layers, and a function of them and of what comes in."""

    def __init__(self, call: Call, out: int, **parts: nn.Module | Tensor):
        super().__init__()
        self.call, self.out = call, out
        for name, part in parts.items():
            setattr(self, name, part if isinstance(part, nn.Module) else nn.Parameter(part))

    def forward(self, x: Tensor) -> Tensor:
        return self.call(self, x)


Maker = Callable[[random.Random, int], Block]


def _divisor(rng: random.Random, width: int) -> int:
    return rng.choice([number for number in (2, 4, 8) if width % number == 0])


def _width(rng: random.Random) -> int:
    return rng.choice((8, 12, 16, 24))


# images (B, C, H, W)


def convolution(rng: random.Random, c: int) -> Block:
    o = _width(rng)
    return Block(lambda s, x: functional.relu(s.a(x)), o, a=nn.Conv2d(c, o, 3, padding=1))


def grouped(rng: random.Random, c: int) -> Block:
    g = _divisor(rng, c)
    o = g * rng.choice((1, 2, 3, 4))
    return Block(lambda s, x: functional.gelu(s.a(x)), o, a=nn.Conv2d(c, o, 3, padding=1, groups=g))


def grouped_residual(rng: random.Random, c: int) -> Block:
    a = nn.Conv2d(c, c, 3, padding=1, groups=_divisor(rng, c), bias=rng.random() < 0.5)
    return Block(lambda s, x: x + functional.relu(s.a(x)), c, a=a)


def depthwise(rng: random.Random, c: int) -> Block:
    o, m = _width(rng), rng.choice((1, 2))
    parts = {"a": nn.Conv2d(c, c * m, 3, padding=1, groups=c), "n": nn.BatchNorm2d(c * m), "b": nn.Conv2d(c * m, o, 1)}
    return Block(lambda s, x: s.b(functional.silu(s.n(s.a(x)))), o, **parts)


def transposed(rng: random.Random, c: int) -> Block:
    o = _width(rng)
    a = nn.ConvTranspose2d(c, o, 3, padding=1, bias=rng.random() < 0.5)
    return Block(lambda s, x: functional.relu(s.a(x)), o, a=a)


def transposed_grouped(rng: random.Random, c: int) -> Block:
    g = _divisor(rng, c)
    o = g * rng.choice((1, 2, 4))
    return Block(lambda s, x: s.a(x), o, a=nn.ConvTranspose2d(c, o, 4, 2, 1, groups=g))


def batch_norm(rng: random.Random, c: int) -> Block:
    return Block(lambda s, x: functional.relu(s.n(s.a(x))), c, a=nn.Conv2d(c, c, 1, bias=False), n=nn.BatchNorm2d(c))


def group_norm(rng: random.Random, c: int) -> Block:
    parts = {"a": nn.Conv2d(c, c, 3, padding=1), "n": nn.GroupNorm(_divisor(rng, c), c)}
    return Block(lambda s, x: functional.silu(s.n(s.a(x))), c, **parts)


def instance_norm(rng: random.Random, c: int) -> Block:
    return Block(lambda s, x: functional.relu(s.n(x)), c, n=nn.InstanceNorm2d(c, affine=rng.random() < 0.5))


def pooling(rng: random.Random, c: int) -> Block:
    pool = rng.choice((nn.MaxPool2d(2), nn.AvgPool2d(2), nn.AdaptiveAvgPool2d(5), nn.AdaptiveMaxPool2d((3, 4))))
    return Block(lambda s, x: s.p(x), c, p=pool)


def interpolation(rng: random.Random, c: int) -> Block:
    mode = rng.choice(("nearest", "bilinear", "bicubic", "nearest-exact", "area"))
    return Block(lambda s, x: functional.interpolate(s.a(x), size=(6, 7), mode=mode), c, a=nn.Conv2d(c, c, 1))


def residual(rng: random.Random, c: int) -> Block:
    h = _width(rng)
    parts = {"a": nn.Conv2d(c, h, 3, padding=1), "n": nn.BatchNorm2d(h), "b": nn.Conv2d(h, c, 3, padding=1)}
    return Block(lambda s, x: functional.relu(x + s.b(functional.relu(s.n(s.a(x))))), c, **parts)


def shared(rng: random.Random, c: int) -> Block:
    return Block(lambda s, x: functional.relu(s.a(functional.relu(s.a(x)))), c, a=nn.Conv2d(c, c, 3, padding=1))


def concatenation(rng: random.Random, c: int) -> Block:
    o, h = _width(rng), _width(rng)
    parts = {"a": nn.Conv2d(c, h, 3, padding=1), "b": nn.Conv2d(c + h, o, 1)}
    return Block(lambda s, x: s.b(torch.cat([x, functional.relu(s.a(x))], 1)), o, **parts)


def uneven_split(rng: random.Random, c: int) -> Block:
    h, o, first = _width(rng), _width(rng), rng.choice((3, 4))

    def call(s: Block, x: Tensor) -> Tensor:
        one, other = s.a(x).split([first, h - first], 1)
        return s.b(functional.relu(one)) + s.c(torch.tanh(other))

    parts = {"a": nn.Conv2d(c, h, 1), "b": nn.Conv2d(first, o, 1), "c": nn.Conv2d(h - first, o, 1)}
    return Block(call, o, **parts)


def squeezed_gate(rng: random.Random, c: int) -> Block:
    h = _width(rng)

    def call(s: Block, x: Tensor) -> Tensor:
        return x * torch.sigmoid(s.b(functional.relu(s.a(x.mean((2, 3))))))[:, :, None, None]

    return Block(call, c, a=nn.Linear(c, h), b=nn.Linear(h, c))


def clamped(rng: random.Random, c: int) -> Block:
    lo, hi = -torch.rand(1, c, 1, 1), torch.rand(c, 1, 1)

    def call(s: Block, x: Tensor) -> Tensor:
        return torch.clamp(s.a(x), min=s.lo, max=s.hi)

    return Block(call, c, a=nn.Conv2d(c, c, 1), lo=lo, hi=hi)


def pixel_shuffle(rng: random.Random, c: int) -> Block:
    o = _width(rng)
    return Block(lambda s, x: functional.pixel_shuffle(s.a(x), 2), o, a=nn.Conv2d(c, 4 * o, 1))


def channel_shuffle(rng: random.Random, c: int) -> Block:
    g = _divisor(rng, c)

    def call(s: Block, x: Tensor) -> Tensor:
        y = x.reshape(x.shape[0], g, c // g, *x.shape[2:]).transpose(1, 2).reshape(x.shape)
        return functional.relu(s.a(y))

    return Block(call, c, a=nn.Conv2d(c, c, 3, padding=1, groups=g))


def padded(rng: random.Random, c: int) -> Block:
    mode = rng.choice(("zeros", "reflect", "circular"))
    return Block(lambda s, x: functional.elu(s.a(x)), c, a=nn.Conv2d(c, c, 3, padding=1, padding_mode=mode))


def parts(rng: random.Random, c: int) -> Block:
    """Branches side by side, some of them twice, as they are, or of one number."""
    h, k, o, form = (
        _width(rng),
        rng.choice((3, 5, 6)),
        _width(rng),
        rng.choice(("plain", "twice", "nested", "constant")),
    )
    more = {"plain": 0, "twice": h, "nested": c + h, "constant": 2}[form]

    def call(s: Block, x: Tensor) -> Tensor:
        one, other = functional.relu(s.a(x)), s.b(x)
        last = {"plain": [], "twice": [-one], "constant": [x.new_ones(x.shape[0], 2, *x.shape[2:])],
                "nested": [torch.cat([x, one], 1)]}[form]  # fmt: skip
        return functional.relu(s.c(torch.cat([other, one, *last], 1)))

    layers = {"a": nn.Conv2d(c, h, 3, padding=1), "b": nn.Conv2d(c, k, 1), "c": nn.Conv2d(h + k + more, o, 1)}
    return Block(call, o, **layers)


def skip_connection(rng: random.Random, c: int) -> Block:
    h, o, form = _width(rng), _width(rng), rng.choice(("transposed", "bilinear"))

    def call(s: Block, x: Tensor) -> Tensor:
        deep = functional.silu(s.n(s.a(functional.max_pool2d(x, 2, ceil_mode=True))))
        deep = s.u(deep) if form == "transposed" else deep
        deep = functional.interpolate(deep, size=x.shape[2:], mode="bilinear")
        return functional.relu(s.b(torch.cat((deep, x), 1)))

    up = nn.ConvTranspose2d(h, h, 4, 2, 1) if form == "transposed" else nn.Identity()
    layers = {"a": nn.Conv2d(c, h, 3, padding=1), "n": nn.GroupNorm(_divisor(rng, h), h), "u": up}
    return Block(call, o, **layers, b=nn.Conv2d(c + h, o, 3, padding=1))


def dense_growth(rng: random.Random, c: int) -> Block:
    g, count = rng.choice((4, 6)), rng.choice((2, 3))

    def call(s: Block, x: Tensor) -> Tensor:
        for norm, layer in zip(s.n, s.a, strict=True):
            x = torch.cat([x, layer(functional.relu(norm(x)))], 1)
        return x

    widths = [c + g * number for number in range(count)]
    norms = nn.ModuleList(nn.BatchNorm2d(width) for width in widths)
    growing = nn.ModuleList(nn.Conv2d(width, g, 3, padding=1) for width in widths)
    o = _width(rng)
    return Block(lambda s, x: s.b(call(s, x)), o, n=norms, a=growing, b=nn.Conv2d(c + g * count, o, 1))


def norm_of_parts(rng: random.Random, c: int) -> Block:
    h, o = _width(rng), _width(rng)
    norm = rng.choice((
        nn.BatchNorm2d(c + h), nn.GroupNorm(_divisor(rng, c + h), c + h), nn.PReLU(c + h),
        nn.Conv2d(c + h, c + h, 3, padding=1, groups=_divisor(rng, c + h)), nn.Conv2d(c + h, c + h, 1, groups=c + h),
    ))  # fmt: skip
    layers = {"a": nn.Conv2d(c, h, 1), "n": norm, "b": nn.Conv2d(c + h, o, 1)}
    return Block(lambda s, x: s.b(functional.silu(s.n(torch.cat([s.a(x), x], 1)))), o, **layers)


def sliced(rng: random.Random, c: int) -> Block:
    h = rng.choice((12, 16, 24))
    call: Call = rng.choice((
        lambda s, x: s.b(s.a(x)[:, : h // 2] * s.a(x)[:, -(h // 2) :]),
        lambda s, x: s.b(torch.cat([s.a(x)[:, 5:], x[:, :2]], 1)[:, : h // 2]),
        lambda s, x: s.b(s.a(x)[:, ::2] + s.a(x)[:, 1::2]), lambda s, x: s.b(s.a(x).narrow(1, 3, h // 2)),
    ))  # fmt: skip
    return Block(call, c, a=nn.Conv2d(c, h, 1), b=nn.Conv2d(h // 2, c, 3, padding=1))


def crossing_stages(rng: random.Random, c: int) -> Block:
    h, first = _width(rng), rng.choice((c // 2, 3))

    def call(s: Block, x: Tensor) -> Tensor:
        one, other = x.split([first, c - first], 1)
        y = torch.cat([functional.relu(s.a(other)), one], 1)
        return s.b(functional.channel_shuffle(y, 2) if c % 2 == 0 else y)

    return Block(call, h, a=nn.Conv2d(c - first, c - first, 3, padding=1), b=nn.Conv2d(c, h, 1))


def added_channels(rng: random.Random, c: int) -> Block:
    o, before = c + rng.choice((4, 6)), rng.choice((0, 2))

    def call(s: Block, x: Tensor) -> Tensor:
        return functional.relu(s.a(x) + functional.pad(x, (0, 0, 0, 0, before, o - c - before)))

    return Block(lambda s, x: s.b(call(s, x)), c, a=nn.Conv2d(c, o, 3, padding=1), b=nn.Conv2d(o, c, 1))


IMAGES: tuple[Maker, ...] = (
    convolution, grouped, grouped_residual, depthwise, transposed, transposed_grouped, batch_norm, group_norm,
    instance_norm, pooling, interpolation, residual, shared, concatenation, uneven_split, squeezed_gate, clamped,
    pixel_shuffle, channel_shuffle, padded, parts, skip_connection, dense_growth, norm_of_parts, sliced,
    crossing_stages, added_channels,
)  # fmt: skip


# sequences (B, T, C)


def mlp(rng: random.Random, c: int) -> Block:
    h = _width(rng)
    parts = {"n": nn.LayerNorm(c), "a": nn.Linear(c, h), "b": nn.Linear(h, c)}
    return Block(lambda s, x: x + s.b(functional.gelu(s.a(s.n(x)))), c, **parts)


def rms_norm(rng: random.Random, c: int) -> Block:
    o = _width(rng)
    return Block(
        lambda s, x: s.b(s.n(functional.silu(s.a(x)))), c, a=nn.Linear(c, o), n=nn.RMSNorm(o), b=nn.Linear(o, c)
    )


def gated(rng: random.Random, c: int) -> Block:
    h, form = _width(rng), rng.choice(("chunk", "glu", "two"))

    def call(s: Block, x: Tensor) -> Tensor:
        y = s.a(x)
        if form == "glu":
            return s.b(functional.glu(y, -1))
        one, other = y.chunk(2, -1) if form == "chunk" else (y[..., :h], y[..., h:])
        return s.b(functional.silu(one) * other)

    return Block(call, c, a=nn.Linear(c, 2 * h), b=nn.Linear(h, c))


def attention(rng: random.Random, c: int) -> Block:
    heads, d, form = rng.choice((2, 3, 4)), rng.choice((4, 6)), rng.choice(("softmax", "sdpa", "einsum", "unbind"))

    def call(s: Block, x: Tensor) -> Tensor:
        batch, length, _ = x.shape
        y = s.a(x).reshape(batch, length, 3, heads, d)
        q, k, v = y.unbind(2) if form == "unbind" else (y[:, :, 0], y[:, :, 1], y[:, :, 2])
        if form == "einsum":
            mixed = torch.einsum("bhts,bshd->bthd", torch.softmax(torch.einsum("bthd,bshd->bhts", q, k), -1), v)
            return x + s.b(mixed.flatten(2))
        q, k, v = (each.transpose(1, 2) for each in (q, k, v))
        if form == "softmax":
            mixed = torch.softmax(q @ k.transpose(-2, -1) * 0.4 + s.bias, -1) @ v
        else:
            mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=s.bias)
        return x + s.b(mixed.transpose(1, 2).reshape(batch, length, heads * d))

    parts = {"a": nn.Linear(c, 3 * heads * d), "b": nn.Linear(heads * d, c), "bias": torch.randn(heads, 1, 1)}
    return Block(call, c, **parts)


def shared_keys(rng: random.Random, c: int) -> Block:
    pairs, each, d, form = 2, rng.choice((2, 3)), 4, rng.choice(("expand", "repeat", "gqa"))

    def call(s: Block, x: Tensor) -> Tensor:
        batch, length, _ = x.shape
        q = s.q(x).view(batch, length, pairs * each, d).transpose(1, 2)
        k, v = (y.view(batch, length, pairs, d).transpose(1, 2) for y in (s.k(x), s.v(x)))
        if form == "expand":
            k, v = (y[:, :, None].expand(batch, pairs, each, length, d).reshape(batch, -1, length, d) for y in (k, v))
        if form == "repeat":
            k, v = (y.repeat_interleave(each, 1) for y in (k, v))
        mixed = functional.scaled_dot_product_attention(q, k, v, enable_gqa=form == "gqa")
        return s.o(mixed.transpose(1, 2).flatten(2))

    parts = {"q": nn.Linear(c, pairs * each * d), "k": nn.Linear(c, pairs * d), "v": nn.Linear(c, pairs * d)}
    return Block(call, c, o=nn.Linear(pairs * each * d, c), **parts)


def torch_attention(rng: random.Random, c: int) -> Block:
    layer = nn.TransformerEncoderLayer(c, 4, _width(rng), batch_first=True, norm_first=rng.random() < 0.5)
    return Block(lambda s, x: s.a(x), c, a=layer)


def experts(rng: random.Random, c: int) -> Block:
    e, h = rng.choice((2, 4)), _width(rng)

    def call(s: Block, x: Tensor) -> Tensor:
        w = torch.softmax(s.g(x), -1)
        t, i = w.topk(2, -1)
        w = torch.zeros_like(w).scatter(-1, i, t)
        y = torch.einsum("bteh,ehd->bted", functional.gelu(torch.einsum("btd,edh->bteh", x, s.u)), s.d)
        return x + (w[..., None] * y).sum(2)

    return Block(call, c, g=nn.Linear(c, e), u=0.3 * torch.randn(e, c, h), d=0.3 * torch.randn(e, h, c))


def einsum(rng: random.Random, c: int) -> Block:
    h = _width(rng)
    up, down = rng.choice(("...d,dh->...h", "btd,dh->bth", "abc,cd")), rng.choice(("bth,hd->btd", "...h,hz"))
    return Block(lambda s, x: torch.einsum(down, torch.tanh(torch.einsum(up, x, s.u)), s.d), c,
                 u=0.3 * torch.randn(c, h), d=0.3 * torch.randn(h, c))  # fmt: skip


def recurrent(rng: random.Random, c: int) -> Block:
    h, both, layers = _width(rng), rng.random() < 0.4, rng.choice((1, 2))
    kind = rng.choice((nn.GRU, nn.LSTM, nn.RNN))
    layer = kind(c, h, layers, batch_first=True, bidirectional=both, bias=rng.random() < 0.8)
    return Block(lambda s, x: s.b(s.a(x)[0]), c, a=layer, b=nn.Linear(h * (1 + both), c))


def recurrent_cell(rng: random.Random, c: int) -> Block:
    h, long = _width(rng), rng.random() < 0.5

    def call(s: Block, x: Tensor) -> Tensor:
        state, memory, seen = torch.zeros(x.shape[0], h), x.new_zeros(x.shape[0], h), []
        for step in range(3):
            if long:
                state, memory = s.a(x[:, step], (state, memory))
            else:
                state = s.a(x[:, step], state)
            seen.append(state)
        return s.b(torch.stack(seen, 1))

    return Block(call, c, a=(nn.LSTMCell if long else nn.GRUCell)(c, h), b=nn.Linear(h, c))


def over_time(rng: random.Random, c: int) -> Block:
    h, g = 16, rng.choice((1, 2, 4))
    parts = {
        "a": nn.Conv1d(c, h, 3, padding=1),
        "n": nn.GroupNorm(4, h),
        "b": nn.Conv1d(h, c * g, 3, padding=1, groups=g),
    }

    def call(s: Block, x: Tensor) -> Tensor:
        y = s.b(functional.mish(s.n(s.a(x.transpose(1, 2)))))
        return y.transpose(1, 2).unflatten(-1, (c, g)).mean(-1)

    return Block(call, c, **parts)


def tied(rng: random.Random, c: int) -> Block:
    block = Block(lambda s, x: x + torch.tanh(s.b(functional.relu(s.a(x)))), c, a=nn.Linear(c, c), b=nn.Linear(c, c))
    block.b.weight = block.a.weight
    return block


def tied_back(rng: random.Random, c: int) -> Block:
    h = _width(rng)
    return Block(lambda s, x: functional.linear(functional.relu(s.a(x)), s.a.weight.t()), c, a=nn.Linear(c, h))


def added_places(rng: random.Random, c: int) -> Block:
    return Block(lambda s, x: s.a(x) + s.p[:, : x.shape[1]], c, a=nn.Linear(c, c), p=torch.randn(1, 16, c))


def stacked(rng: random.Random, c: int) -> Block:
    parts = {"a": nn.Linear(c, c), "b": nn.Linear(c, c)}
    return Block(lambda s, x: torch.stack([s.a(x), functional.relu(s.b(x))], 2).amax(2), c, **parts)


def sums_so_far(rng: random.Random, c: int) -> Block:
    return Block(lambda s, x: s.a(x).cumsum(1) * 0.2, c, a=nn.Linear(c, c))


def weight_norm(rng: random.Random, c: int) -> Block:
    h = _width(rng)
    a = nn.utils.parametrizations.weight_norm(nn.Linear(c, h))
    return Block(lambda s, x: s.b(functional.relu(s.a(x))), c, a=a, b=nn.Linear(h, c))


def joined(rng: random.Random, c: int) -> Block:
    h, k, form = _width(rng), rng.choice((3, 5)), rng.choice(("state", "added", "global", "turned"))

    def call(s: Block, x: Tensor) -> Tensor:
        one, other = torch.tanh(s.a(x)), s.d(x)
        if form == "added":
            return s.b(torch.cat([one, other], -1) + torch.cat([other, one], -1))
        if form == "turned":
            return s.b(torch.cat([*torch.cat([one, other], -1).split([k + 1, h - 1], -1)[::-1]], -1))
        if form == "global":
            other = other.amax(1, keepdim=True).expand(-1, x.shape[1], -1)
        return s.b(torch.cat([other, one], -1))

    return Block(call, c, a=nn.Linear(c, h), d=nn.Linear(c, k), b=nn.Linear(h + k, c))


def grouped_queries(rng: random.Random, c: int) -> Block:
    pairs, each, d, up = 2, rng.choice((1, 2, 3)), 4, rng.choice((6, 8))
    sizes = [pairs * each * d, pairs * d, pairs * d, up, up]

    def call(s: Block, x: Tensor) -> Tensor:
        q, k, v, gate, y = s.a(x).split(sizes, -1)
        q, k, v = (part.unflatten(-1, (-1, d)).transpose(1, 2) for part in (q, k, v))
        mixed = functional.scaled_dot_product_attention(q, k, v, enable_gqa=True).transpose(1, 2).flatten(2)
        return x + s.b(torch.cat([mixed, functional.silu(gate) * y], -1))

    return Block(call, c, a=nn.Linear(c, sum(sizes)), b=nn.Linear(pairs * each * d + up, c))


def gates(rng: random.Random, c: int) -> Block:
    h = _width(rng)

    def call(s: Block, x: Tensor) -> Tensor:
        state = memory = torch.zeros(x.shape[0], h)
        for step in range(2):
            one, two, three, four = s.a(torch.cat([x[:, step], state], -1)).chunk(4, -1)
            memory = torch.sigmoid(two) * memory + torch.sigmoid(one) * torch.tanh(three)
            state = torch.sigmoid(four) * torch.tanh(memory)
        return x + s.b(state)[:, None]

    return Block(call, c, a=nn.Linear(c + h, 4 * h), b=nn.Linear(h, c))


def rotated(rng: random.Random, c: int) -> Block:
    heads, d, form = rng.choice((2, 3)), 4, rng.choice(("halves", "slices", "pairs"))

    def turned(x: Tensor) -> Tensor:
        if form == "pairs":
            return torch.stack([-x[..., 1::2], x[..., ::2]], -1).flatten(-2)
        one, other = x.chunk(2, -1) if form == "halves" else (x[..., : d // 2], x[..., d // 2 :])
        return torch.cat([-other, one], -1)

    def call(s: Block, x: Tensor) -> Tensor:
        q, k, v = (each.unflatten(-1, (heads, d)).transpose(1, 2) for each in s.a(x).chunk(3, -1))
        q, k = (each * s.cos + turned(each) * s.sin for each in (q, k))
        return x + s.b((torch.softmax(q @ k.mT * 0.4, -1) @ v).transpose(1, 2).flatten(2))

    angles = torch.arange(6.0)[:, None] * torch.tensor([1.0, 0.1, 1.0, 0.1])
    parts = {"a": nn.Linear(c, 3 * heads * d), "b": nn.Linear(heads * d, c), "cos": angles.cos(), "sin": angles.sin()}
    return Block(lambda s, x: call(s, x) if x.shape[1] == 6 else x + s.b(s.a(x)[..., : heads * d]), c, **parts)


def along_time(rng: random.Random, c: int) -> Block:
    extra, form = rng.choice((1, 2)), rng.choice(("tokens", "shift", "window"))

    def call(s: Block, x: Tensor) -> Tensor:
        y = s.a(x)
        if form == "tokens":
            return s.b(torch.cat([s.t.expand(x.shape[0], -1, -1), y], 1))[:, extra:]
        if form == "shift":
            moved = [functional.pad(y[:, 1:, :3], (0, 0, 0, 1)), functional.pad(y[:, :-1, 3:5], (0, 0, 1, 0))]
            return s.b(torch.cat([*moved, y[..., 5:]], -1))
        return s.b(functional.pad(y, (0, 0, 1, 0)).unfold(1, 2, 1).amax(-1))

    return Block(call, c, a=nn.Linear(c, c), b=nn.Linear(c, c), t=torch.randn(1, extra, c))


def written(rng: random.Random, c: int) -> Block:
    h, k = _width(rng), rng.choice((2, 5))

    def call(s: Block, x: Tensor) -> Tensor:
        y = torch.zeros(*x.shape[:2], h + k)
        y[..., :k], y[..., k:] = s.d(x), torch.tanh(s.a(x))
        return s.b(y)

    return Block(call, c, a=nn.Linear(c, h), d=nn.Linear(c, k), b=nn.Linear(h + k, c))


def heads_of_parts(rng: random.Random, c: int) -> Block:
    h, k = rng.choice((8, 12)), rng.choice((4, 6))
    heads = rng.choice([each for each in (2, 4, 5) if (h + k) % each == 0])

    def call(s: Block, x: Tensor) -> Tensor:
        y = torch.cat([s.d(x), s.a(x)], -1).unflatten(-1, (heads, -1)).transpose(1, 2)
        return s.b((torch.softmax(y @ y.mT * 0.1, -1) @ y).transpose(1, 2).flatten(2))

    return Block(call, c, a=nn.Linear(c, h), d=nn.Linear(c, k), b=nn.Linear(h + k, c))


def without_rule(rng: random.Random, c: int) -> Block:
    call = rng.choice((
        lambda s, x: s.b(torch.cummax(s.a(x), 1)[0]), lambda s, x: s.b(torch.renorm(s.a(x), 2, 0, 3.0)),
        lambda s, x: s.b(s.a(x)) * torch.cdist(x, x).mean((1, 2), keepdim=True),
        lambda s, x: s.b(torch.nan_to_num(torch.logcumsumexp(s.a(x), 2)).unfold(1, 2, 2).sum(-1)),
    ))  # fmt: skip
    return Block(call, c, a=nn.Linear(c, c), b=nn.Linear(c, c))


SEQUENCES: tuple[Maker, ...] = (
    mlp, rms_norm, gated, attention, shared_keys, torch_attention, experts, einsum, recurrent, recurrent_cell,
    over_time, tied, tied_back, added_places, stacked, sums_so_far, weight_norm, without_rule, joined, grouped_queries,
    gates, rotated, along_time, written, heads_of_parts,
)  # fmt: skip


def chosen(rng: random.Random) -> tuple[list[Maker], list[Maker]]:
    """Draw the blocks of a module: those over an image, and those over a sequence."""
    form = rng.choice(("image", "sequence", "both"))
    image = rng.choices(IMAGES, k=rng.randint(1, 3)) if form != "sequence" else []
    return image, rng.choices(SEQUENCES, k=rng.randint(1, 3)) if form != "image" else []


class RandomModule(nn.Module):
    """Blocks over an image, over a sequence, then a head; which ones and how wide by a seed."""

    def __init__(self, seed: int):
        super().__init__()
        torch.manual_seed(seed)
        rng = random.Random(seed)
        image, sequence = chosen(rng)
        self.kinds = [make.__name__ for make in (*image, *sequence)]
        width = _width(rng)
        self.first = nn.Conv2d(3, width, 3, padding=1) if image else nn.Linear(5, width)
        self.image, width = _chain(rng, image, width)
        self.turned = bool(image)
        self.sequence, width = _chain(rng, sequence, width)
        self.end = rng.choice(("mean", "flat"))
        self.hidden = nn.LazyLinear(16)
        self.head = nn.Linear(16, 6)
        self.eval()
        with torch.no_grad():
            self(self.example(seed))
        for name, value in self.named_buffers():
            if name.endswith("running_mean"):
                value.normal_()
            if name.endswith("running_var"):
                value.uniform_(0.5, 2.0)

    def example(self, seed: int, batch: int = 1) -> Tensor:
        random_numbers = torch.Generator().manual_seed(seed)
        shape = (batch, 3, SIDE, SIDE) if self.turned else (batch, LENGTH, 5)
        return torch.randn(shape, generator=random_numbers)

    def forward(self, x: Tensor) -> Tensor:
        x = functional.relu(self.first(x))
        for block in self.image:
            x = block(x)
        if self.turned:
            if len(self.sequence):
                x = functional.adaptive_avg_pool2d(x, (2, 3)).flatten(2).transpose(1, 2)
            elif self.end == "mean":
                x = x.mean((2, 3))
        for block in self.sequence:
            x = block(x)
        if x.dim() == 3 and self.end == "mean":
            x = x.mean(1)
        return self.head(functional.relu(self.hidden(x.flatten(1)))).reshape(-1, 2, 3)


def _chain(rng: random.Random, makers: Sequence[Maker], width: int) -> tuple[nn.ModuleList, int]:
    blocks = nn.ModuleList()
    for make in makers:
        block = make(rng, width)
        blocks.append(block)
        width = block.out
    return blocks, width


def main(modules: int) -> None:
    """Print how many of the first modules have each kind of block."""
    kinds = Counter(make.__name__ for seed in range(modules) for make in set(chain(*chosen(random.Random(seed)))))
    print(", ".join(f"{name.replace('_', ' ')} {kinds[name]}" for name in sorted(kinds)))


if __name__ == "__main__":
    main(int(sys.argv[1]))
