"""Axes of weights that belong together, found through reshapes; and modules without some of their units."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from _full import small_or_full
from torch import nn
from torch.nn import functional

from vlatool.errors import SourceError
from vlatool.module._resizer import Resizer
from vlatool.module.axes import Member, Walk
from vlatool.module.edits import Edit
from vlatool.module.factors import Factors
from vlatool.module.unit_removal import RETRACE, remove_units, trace_module

WIDTH, HEADS = 24, 4


class Attention(nn.Module):
    """Heads are found in reshapes alone: no attribute says how many there are."""

    def __init__(self, form: str):
        super().__init__()
        self.form = form
        self.joint = nn.Linear(WIDTH, 3 * WIDTH)
        self.output = nn.Linear(WIDTH, WIDTH)
        self.norm = nn.LayerNorm(WIDTH)

    def forward(self, tokens):
        batch, length, _ = tokens.shape
        x = self.joint(self.norm(tokens))
        if self.form == "chunk":
            parts = [part.reshape(batch, length, HEADS, -1).transpose(1, 2) for part in x.chunk(3, -1)]
        elif self.form == "split":
            parts = [part.view(batch, length, HEADS, -1).transpose(1, 2) for part in x.split(WIDTH, dim=-1)]
        else:
            parts = list(x.reshape(batch, length, 3, HEADS, -1).permute(2, 0, 3, 1, 4).unbind(0))
        query, key, value = parts
        if self.form == "sdpa":
            mixed = functional.scaled_dot_product_attention(query, key, value, scale=0.4)
        else:
            mixed = torch.softmax(query @ key.transpose(-2, -1) * 0.4, -1) @ value
        return tokens + self.output(mixed.transpose(1, 2).reshape(batch, length, WIDTH))


def units(walk: Walk) -> dict[str, int]:
    """Return first weight with axis and place -> number of units, of all that may go."""
    return {
        f"{members[0].weight} {members[0].units.removeprefix('units ')}": walk.factors.sizes[leaf]
        for leaf, members in walk.members().items()
    }


def walked(module: nn.Module, *feeds: torch.Tensor) -> Walk:
    return Walk(trace_module(module.eval(), feeds))


@pytest.mark.parametrize("form", ["chunk", "split"])
def test_heads_are_found_in_reshapes(form: str):
    walk = walked(Attention(form), torch.randn(2, 5, WIDTH))
    assert units(walk) == {"joint.weight 0.1": HEADS, "joint.weight 0.2": WIDTH // HEADS}
    members = next(iter(walk.members().values()))
    assert [(each.weight, each.units) for each in members] == [
        ("joint.weight", "units 0.1"),
        ("joint.bias", "units 0.1"),
        ("output.weight", "units 1.0"),
    ]
    assert members[0].numbers.tolist() == 3 * [number for number in range(HEADS) for _ in range(WIDTH // HEADS)]


@pytest.mark.parametrize("form", ["chunk", "split"])
def test_a_head_that_goes_is_a_head_that_says_nothing(form: str):
    torch.manual_seed(0)
    module, tokens = Attention(form).eval(), torch.randn(1, 5, WIDTH)
    small = remove_units(module, [tokens], [Edit("main", "joint.weight", "units 0.1", (0, 3))])
    with torch.no_grad():
        module.output.weight.view(WIDTH, HEADS, -1)[:, 1:3] = 0
        torch.testing.assert_close(small(tokens), module(tokens))
    sizes = {name: tuple(value.shape) for name, value in small.state_dict().items()}
    assert (sizes["joint.weight"], sizes["joint.bias"], sizes["output.weight"]) == ((36, 24), (36,), (24, 12))
    assert [name for name, _ in small.named_children()] == ["joint", "output", "norm"]
    assert small(tokens.expand(3, -1, -1)).shape == (3, 5, WIDTH)


class Conv(nn.Module):
    def __init__(self):
        super().__init__()
        self.first = nn.Conv2d(3, 8, 3, padding=1)
        self.norm = nn.BatchNorm2d(8)
        self.deep = nn.Conv2d(8, 8, 3, padding=1, groups=8)
        self.second = nn.Conv2d(8, 8, 3, padding=1)
        self.film = nn.Linear(4, 16)
        self.last = nn.Linear(8 * 6 * 6, 5)

    def forward(self, image, words):
        x = functional.relu(self.norm(self.first(image)))
        scale, shift = self.film(words)[:, :, None, None].chunk(2, 1)
        x = x + self.second(self.deep(x)) * (1 + scale) + shift
        return self.last(x.flatten(1))


def test_channels_are_coupled_through_normalisation_depth_residual_film_and_flatten():
    torch.manual_seed(0)
    module, feeds = Conv().eval(), (torch.randn(1, 3, 6, 6), torch.randn(1, 4))
    walk = walked(module, *feeds)
    assert units(walk) == {"first.weight 0.0": 8}
    coupled = {f"{each.weight} {each.units.removeprefix('units ')}" for each in next(iter(walk.members().values()))}
    assert coupled >= {"norm.running_var 0.0", "deep.weight 0.0", "second.weight 0.0", "second.weight 1.0",
                       "film.weight 0.1", "last.weight 1.0"}  # fmt: skip
    keep = (1, 2, 5)
    small = remove_units(module, list(feeds), [Edit("main", "first.weight", "units 0.0", keep)])
    with torch.no_grad():
        gone = [unit for unit in range(8) if unit not in keep]
        module.last.weight.view(5, 8, 36)[:, gone] = 0
        module.second.weight[:, gone] = 0
        torch.testing.assert_close(small(*feeds), module(*feeds))
    assert small.get_parameter("film.weight").shape == (6, 4)


def test_what_is_normalised_over_read_or_given_stays():
    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.one, self.two, self.norm = nn.Linear(4, 6), nn.Linear(6, 5), nn.LayerNorm(6)
            self.table = nn.Embedding(9, 4)

        def forward(self, ids):
            return torch.cumsum(self.two(self.norm(self.one(self.table(ids)))), -1)

    assert units(walked(Net(), torch.ones(2, 3, dtype=torch.int64))) == {}


class Spatial(nn.Module):
    """Grouped, transposed and depthwise convolutions, normalisation in groups, pools, interpolation, clamps."""

    def __init__(self):
        super().__init__()
        self.first = nn.Linear(3, 8 * 16)
        self.up = nn.ConvTranspose2d(8, 12, 4, 2, 1)
        self.norm = nn.GroupNorm(4, 12)
        self.grouped = nn.Conv2d(12, 24, 3, padding=1, groups=4)
        self.deep = nn.Conv2d(24, 48, 3, padding=1, groups=24)
        self.down = nn.ConvTranspose2d(48, 16, 2, groups=8)
        self.least, self.most = nn.Parameter(-torch.rand(16, 1, 1)), nn.Parameter(torch.rand(16, 1, 1))
        self.last = nn.Linear(16 * 4, 5)

    def forward(self, state):
        x = self.up(self.first(state).relu().view(-1, 8, 4, 4))
        x = functional.max_pool2d(functional.silu(self.norm(x)), 2)
        x = self.deep(self.grouped(x).relu())
        x = self.down(functional.interpolate(x, scale_factor=2, mode="bilinear"))
        x = torch.clamp(x, min=self.least, max=self.most)
        return self.last(functional.adaptive_avg_pool2d(x, 2).flatten(1))


class Mixed(nn.Module):
    """Products in einsum, attention with a bias for each head, a recurrent layer and a cell that begin with zeros."""

    def __init__(self):
        super().__init__()
        self.up, self.down = nn.Parameter(torch.randn(3, 6, 8)), nn.Parameter(torch.randn(3, 8, 6))
        self.joint, self.bias, self.out = nn.Linear(6, 3 * 4 * 2), nn.Parameter(torch.randn(4, 1, 1)), nn.Linear(8, 6)
        self.layer, self.cell, self.last = nn.GRU(6, 8, batch_first=True), nn.LSTMCell(8, 10), nn.Linear(10, 2)

    def forward(self, x):
        parts = torch.softmax(x[..., :3], -1)
        hidden = torch.einsum("btd,edh->bteh", x, self.up).relu()
        x = x + torch.einsum("bteh,ehd,bte->btd", hidden, self.down, parts)
        q, k, v = self.joint(x).unflatten(-1, (3, 4, 2)).transpose(1, 3).unbind(2)
        x = x + self.out((torch.softmax(q @ k.mT + self.bias, -1) @ v).transpose(1, 2).flatten(2))
        x, state = self.layer(x)[0], (torch.zeros(len(x), 10), x.new_zeros(len(x), 10))
        for step in range(2):
            state = self.cell(x[:, step], state)
        return self.last(state[0])


@pytest.mark.parametrize(("make", "shape", "wanted"), [
    (Spatial, (1, 3), {
        "first.weight 0.0": 8, "least 0.0": 4, "least 0.1": 2, "least 0.2": 2, "grouped.weight 0.2": 3,
        "deep.weight 0.3": 2,
    }),
    (Mixed, (1, 4, 6), {
        "up 2.0": 8, "bias 0.0": 4, "joint.weight 0.2": 2, "layer.weight_ih_l0 0.1": 8,
        "cell.weight_ih 0.1": 10,
    }),
])  # fmt: skip
def test_units_of_odd_operators_go_without_a_trace(make: type[nn.Module], shape: tuple[int, ...], wanted: dict):
    torch.manual_seed(0)
    module, feed = make().eval(), torch.randn(shape)
    walk = walked(module, feed)
    assert (walk.unknown, units(walk)) == (set(), wanted)
    edits, whole = [], copy.deepcopy(module)
    for members in walk.members().values():
        first, keep = members[0], tuple(range(0, max(members[0].numbers) + 1, 2))
        edits.append(Edit("main", first.weight, first.units, keep))
        for member in members:
            silence(whole.get_parameter(member.weight), member, keep)
    small = remove_units(module, [feed], edits)
    with torch.no_grad():
        torch.testing.assert_close(small(feed), whole(feed))


class Blocked(nn.Module):
    def __init__(self):
        super().__init__()
        self.one, self.two, self.three = nn.Linear(4, 6), nn.Linear(6, 6), nn.Linear(6, 5)

    def forward(self, x):
        return self.three(self.two(torch.cummax(self.one(x), -1)[0]).relu())


def test_an_operator_without_a_rule_keeps_what_touches_it_and_is_named():
    walk = walked(Blocked(), torch.randn(1, 4))
    assert walk.unknown == {"aten.cummax"}
    assert units(walk) == {"two.weight 0.0": 6}
    assert [set().union(*(keepers for _, keepers in walk.terms(product))) for product in range(3)] == [
        {"the policy's inputs", "aten.cummax"}, {"aten.cummax"}, {"the policy's outputs"},
    ]  # fmt: skip


@pytest.mark.parametrize(("call", "macs"), [
    (lambda w, x: torch.chain_matmul(x, w), 3 * 4 * 5), (lambda w, x: torch.tensordot(x, w, dims=1), 3 * 4 * 5),
    (lambda w, x: torch.cummax(x @ w, 1)[0], 3 * 4 * 5), (lambda w, x: torch.einsum("ij,jk", x, w), 3 * 4 * 5),
    (lambda w, x: torch.einsum("ij,ik,jl->kl", x, x, w), 4 * 3 * 4 + 4 * 4 * 5),
    (lambda w, x: torch.mv(w.t(), x[0]), 4 * 5), (lambda w, x: functional.conv1d(x[:, :, None], w.t()[:, :, None]), 60),
    (lambda w, x: functional.conv_transpose1d(x[:, :, None], w[:, :, None]), 60),
])  # fmt: skip
def test_multiply_accumulates_are_counted_with_a_rule_and_without_one(call, macs: int):
    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.randn(4, 5))

        def forward(self, x):
            return call(self.weight, x)

    walk = walked(Net(), torch.randn(3, 4)[None][0])
    assert sum(walk.factors.size(axis for each in product for axis in each) for product in walk.products) == macs


def test_an_operator_of_another_package_is_not_taken_for_one_of_torch():
    @torch.library.custom_op("apart::relu", mutates_args=())
    def relu(x: torch.Tensor) -> torch.Tensor:
        return x.flip(-1)

    relu.register_fake(torch.empty_like)
    walk = walked(nn.Sequential(nn.Linear(4, 6), Called(relu), nn.Linear(6, 2)), torch.randn(1, 4))
    assert (walk.unknown, units(walk)) == ({"apart.relu"}, {})


class Called(nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, x):
        return self.function(x)


def test_a_cut_that_cannot_run_is_not_the_policys_fault(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Resizer, "resize", lambda self, node: None)
    module = nn.Sequential(nn.Linear(4, 8), nn.Unflatten(1, (8, 1)), nn.Flatten(), nn.Linear(8, 3))
    with pytest.raises(RuntimeError, match="what pruning left of the module cannot run: "):
        remove_units(module, [torch.randn(1, 4)], [Edit("main", "0.weight", "units 0.0", (0, 2))])


def test_a_tied_weight_is_one_axis_of_both_names_and_stays_tied():
    class Tied(nn.Module):
        def __init__(self):
            super().__init__()
            self.a, self.b, self.c, self.d = nn.Linear(4, 8), nn.Linear(8, 8), nn.Linear(8, 8), nn.Linear(8, 2)
            self.c.weight = self.b.weight

        def forward(self, x):
            return self.d(self.c(self.b(self.a(x)).relu()))

    module, feed = Tied(), torch.randn(1, 4)
    (members,) = walked(module, feed).members().values()
    assert {each.weight for each in members} >= {"b.weight", "c.weight"}
    small = remove_units(module, [feed], [Edit("main", "a.weight", "units 0.0", (0, 2, 4))])
    assert small.get_parameter("b.weight") is small.get_parameter("c.weight")
    assert small.get_parameter("b.weight").shape == (3, 3)


def test_work_is_counted():
    walk = walked(nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 3)), torch.randn(1, 4))
    sizes = [[walk.factors.size(axis) for axis in product] for product in walk.products]
    assert sizes == [[1, 4, 8], [1, 8, 3]]


def test_a_module_for_one_observation_is_traced_again_for_a_batch():
    class One(nn.Module):
        def __init__(self):
            super().__init__()
            self.up, self.down = nn.Linear(4, 8), nn.Linear(8, 4)

        def forward(self, x):
            assert len(x) in (1, 3), "a size that the code does not know"
            return self.down(self.up(x).relu()).reshape(len(x), 2, 2)

    torch.manual_seed(0)
    small = remove_units(One().eval(), [torch.randn(1, 4)], [Edit("main", "up.weight", "units 0.0", (0, 2, 4))])
    again = getattr(small, RETRACE)(3)
    x = torch.randn(3, 4)
    torch.testing.assert_close(again(x), torch.cat([small(row[None]) for row in x]))
    assert again.get_parameter("up.weight") is small.get_parameter("up.weight")


class Sequenced(nn.Module):
    """torch's attention in its default layout, (sequence, batch, width): heads are counted together with the batch."""

    def __init__(self, *, whole: bool, to_others: bool):
        super().__init__()
        self.to_others, self.whole = to_others, whole
        self.state, self.goal = nn.Linear(4, 8 * 16), nn.Linear(4, 5 * 16)
        self.attention = nn.MultiheadAttention(16, 4)
        self.action = nn.Linear(16, 2)

    def forward(self, state):
        tokens = self.state(state).reshape(-1, 8, 16).transpose(0, 1)
        others = self.goal(state).reshape(state.shape[0], 5, 16).transpose(0, 1) if self.to_others else tokens
        values = 0.5 * others if self.to_others else others
        needs = {"need_weights": self.whole, "average_attn_weights": False}
        return self.action(self.attention(tokens, others, values, **needs)[0]).transpose(0, 1)


@pytest.mark.parametrize(
    ("whole", "to_others"),
    [(True, True), (False, False), *small_or_full([], [(True, False), (False, True)])],
)
def test_units_of_torchs_attention_go_whatever_the_batch_is(whole: bool, to_others: bool):
    torch.manual_seed(0)
    module, feed = Sequenced(whole=whole, to_others=to_others).eval(), torch.randn(1, 4)
    groups = list(walked(module, feed).members().values())
    assert any(member.units == "units 0.1" and not member.atom.is_fastest for members in groups for member in members)
    batch = torch.randn(5, 4)
    for members in groups:
        first = members[0]
        keep, units = tuple(range(0, max(first.numbers) + 1, 2)), first.units
        whole_one = copy.deepcopy(module)
        for member in members:
            silence(whole_one.get_parameter(member.weight), member, keep)
        small = remove_units(copy.deepcopy(module), [feed], [Edit("main", first.weight, units, keep)])
        assert not hasattr(small, RETRACE), "one module for any batch"
        with torch.no_grad():
            torch.testing.assert_close(small(batch), whole_one(batch), msg=f"{first.weight} {units}")
            torch.testing.assert_close(small(batch), torch.cat([small(row[None]) for row in batch]))


def silence(weight: torch.Tensor, member: Member, keep: tuple[int, ...]) -> None:
    """Let the units of one axis of a weight that are not kept do nothing."""
    gone = torch.tensor([at for at, unit in enumerate(member.numbers) if unit >= 0 and unit not in keep])
    with torch.no_grad():
        weight.index_fill_(member.axis, gone.long(), 0.0)


@pytest.mark.parametrize(("edit", "says"), [
    (Edit("main", "0.weight", "units 0.1", (0,)), "cannot be chosen"),
    (Edit("main", "0.weight", "units 1.0", (0,)), "cannot be chosen"),
    (Edit("main", "7.weight", "units 0.0", (0,)), "cannot be chosen"),
    (Edit("main", "0.weight", "units 0.0", (8,)), r"are 8, numbered from 0; an edit keeps number 8"),
])  # fmt: skip
def test_an_edit_that_does_not_fit_is_refused(edit: Edit, says: str):
    module = nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 3))
    with pytest.raises(SourceError, match=says):
        remove_units(module, [torch.randn(1, 4)], [edit])


def test_what_cannot_be_traced_is_told():
    class Loop(nn.Module):
        def forward(self, x):
            while float(x.sum()) > 0:
                x = x - 1
            return x

    with pytest.raises(SourceError, match=r"torch\.export cannot trace Loop") as caught:
        trace_module(Loop(), [torch.ones(1, 2)])
    assert "vlatool prune depth" in caught.value.fix


def test_factors_are_divided_alike():
    factors = Factors()
    one, other = factors.new(24), factors.new(24)
    factors.divide(one[0], 4)
    factors.unite(one, other)
    assert factors.leaves(one) == factors.leaves(other)
    assert [factors.sizes[leaf] for leaf in factors.leaves(other)] == [4, 6]
    third = factors.new(24)
    factors.divide(third[0], 3)
    factors.unite(one, third)
    assert all(factors.is_frozen(leaf) for leaf in (*factors.leaves(one), *factors.leaves(third)))


@pytest.mark.parametrize(("count", "forward"), [
    (2, lambda self, *values: self.down(self.up(sum(values)))),
    (1, lambda self, first, *others: self.down(self.up(sum(others, first)))),
    (3, lambda self, first, *others: self.down(self.up(sum(others, first)))),
    (2, lambda self, first, second, *others: self.down(self.up(sum(others, first - second)))),
])  # fmt: skip
def test_a_forward_may_take_what_is_kept_as_further_arguments(count: int, forward: Callable[..., torch.Tensor]):
    module = type("Further", (nn.Sequential,), {"forward": forward})()
    module.up, module.down = nn.Linear(4, 6), nn.Linear(6, 2)
    small = remove_units(
        module.eval(), [torch.randn(1, 4)] * count, [Edit("main", "up.weight", "units 0.0", (0, 2, 4))]
    )
    batch = [torch.randn(3, 4) for _ in range(count)]
    with torch.no_grad():
        module.down.weight[:, [1, 3, 5]] = 0
    torch.testing.assert_close(small(*batch), module(*batch))


@pytest.mark.parametrize("convert", [
    torch.Tensor.float, torch.Tensor.double, lambda x: x.to(torch.float32), lambda x: x.type(torch.float64),
])  # fmt: skip
def test_a_cut_module_computes_in_the_dtype_that_a_training_asks_for(convert: Callable[..., torch.Tensor]):
    """The trace is of float32; conversions in it are of whatever they are given, as in the module."""

    class Converting(nn.Module):
        def __init__(self):
            super().__init__()
            self.up, self.down = nn.Linear(4, 6), nn.Linear(6, 2)

        def forward(self, x):
            return self.down(convert(self.up(x)).float().relu())

    torch.manual_seed(0)
    module = Converting().eval()
    small = remove_units(module, [torch.randn(1, 4)], [Edit("main", "up.weight", "units 0.0", (0, 2, 4))])
    with torch.no_grad():
        module.down.weight[:, [1, 3, 5]] = 0
    x = torch.randn(3, 4)
    torch.testing.assert_close(small(x), module(x))
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(small(x), module(x), atol=0.02, rtol=0.02)


@pytest.mark.parametrize(("query", "key", "goes"), [
    (torch.relu, torch.sigmoid, True), (lambda x: x * 2 - x, torch.cos, True), (torch.sigmoid, torch.sigmoid, False),
    (lambda x: functional.elu(x) + 1, lambda x: functional.elu(x) + 1, False),
    (lambda x: x.unflatten(-1, (2, 3)).flatten(-2), torch.exp, True), (torch.cos, lambda x: x.clamp(min=0.1), False),
])  # fmt: skip
@pytest.mark.parametrize("form", ["matmul", "einsum"])
def test_a_sum_over_two_values_keeps_units_that_add_to_it_with_weights_of_zero(query, key, goes: bool, form: str):
    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.one, self.other, self.last = nn.Linear(4, 6), nn.Linear(4, 6), nn.Linear(4, 2)

        def forward(self, x):
            one, other = query(self.one(x)), key(self.other(x))
            similar = one @ other.mT if form == "matmul" else torch.einsum("btd,bsd->bts", one, other)
            return self.last(torch.softmax(similar, -1) @ x)

    walk = walked(Net(), torch.randn(1, 3, 4))
    assert bool(units(walk)) == goes
