"""Concatenations, splits and slices of axes: each segment loses its own units, where it is read as well."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from _pruned import assert_same, silence
from torch import Tensor, nn
from torch.nn import functional

from vlatool.errors import SourceError
from vlatool.module.axes import Walk
from vlatool.module.edits import Edit, edits_from
from vlatool.module.unit_removal import remove_units, trace_module

cat = torch.cat


class Joined(nn.Module):
    """Two layers of 12 and 18 units, something between them, and a layer that reads what it gives."""

    def __init__(self, between: Callable[..., Tensor], **parts: nn.Module):
        super().__init__()
        self.a, self.b, self.between = nn.Linear(4, 12), nn.Linear(4, 18), between
        self.parts = nn.ModuleDict(parts)
        self.read, self.last = nn.LazyLinear(8), nn.Linear(8, 3)
        self.eval()(torch.zeros(1, 3, 4))

    def forward(self, x: Tensor) -> Tensor:
        return self.last(self.read(self.between(self.parts, torch.tanh(self.a(x)), functional.silu(self.b(x)), x)))


def filled(_: object, a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    result = torch.zeros(*x.shape[:2], 30)
    result[..., :12] = a
    result[..., 12:] = b
    return result


def grown(_: object, a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    one = cat([a, b], -1)
    return cat([one, one[..., 5:20], cat([b, one], -1)], -1)


def shifted(_: object, a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    return cat([functional.pad(b[:, 1:, :6], (0, 0, 0, 1)), functional.pad(b[:, :-1, 6:10], (0, 0, 1, 0)), a], -1)


def by_heads(_: object, a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    heads = cat([a, b], -1).unflatten(-1, (5, 6)).transpose(1, 2)
    return (torch.softmax(heads @ heads.mT * 0.1, -1) @ heads).transpose(1, 2).flatten(2)


CASES: dict[str, tuple[Callable[..., Tensor], dict[str, nn.Module], list[int]]] = {
    "parts": (lambda s, a, b, x: cat([a, b], -1), {}, [12, 18]),
    "itself": (lambda s, a, b, x: cat([a, a], -1), {}, [12]),
    "the other way round": (lambda s, a, b, x: cat([a, b], -1) * cat([b, a], -1), {}, [6]),
    "an input": (lambda s, a, b, x: cat([x, a, x], -1), {}, [12]),
    "a constant": (lambda s, a, b, x: cat([b, torch.ones(*x.shape[:2], 7)], -1), {}, [7, 18]),
    "nested": (grown, {}, [5, 7, 8, 10]),
    "added to a layer": (lambda s, a, b, x: cat([a, b], -1) + s["c"](x), {"c": nn.Linear(4, 30)}, [12, 18]),
    "added unevenly": (lambda s, a, b, x: cat([a, b], -1) + cat([b[..., :16], s["c"](x)], -1),
                       {"c": nn.Linear(4, 14)}, [2, 4, 8]),
    "along time": (lambda s, a, b, x: cat([a, s["c"](x[:, 1:])], 1), {"c": nn.Linear(4, 12)}, [12]),
    "unequal split": (lambda s, a, b, x: cat([*reversed(b.split([4, 14], -1))], -1), {}, [4, 14]),
    "split with a rest": (lambda s, a, b, x: cat([part.tanh() for part in b.split(7, -1)[::-1]], -1), {}, [4, 7, 7]),
    "unequal chunks": (lambda s, a, b, x: (lambda p: p[0] * p[1] + p[3].sum(-1, True))(s["c"](x).chunk(4, -1)),
                       {"c": nn.Linear(4, 19)}, [5]),
    "tensor_split": (lambda s, a, b, x: (lambda p: p[0] * p[2])(b.tensor_split([7, 11], -1)), {}, [7]),
    "narrow": (lambda s, a, b, x: b.narrow(-1, 2, 5) * b.narrow(-1, -5, 5), {}, [5]),
    "slices": (lambda s, a, b, x: b[..., :6] * b[..., -6:], {}, [6]),
    "every third": (lambda s, a, b, x: b[..., 1::3], {}, [6]),
    "equal parts, one normalised": (lambda s, a, b, x: cat([s["n"](b.chunk(2, -1)[0]), b.chunk(2, -1)[1]], -1),
                                    {"n": nn.LayerNorm(9)}, [9]),
    "halves of parts": (lambda s, a, b, x: functional.glu(cat([a, b], -1), -1), {}, [3, 12]),
    "written piece by piece": (filled, {}, [12, 18]),
    "padded": (lambda s, a, b, x: functional.pad(a, (2, 4), value=0.5) + b, {}, [2, 4, 12]),
    "a slice of it replaced": (lambda s, a, b, x: torch.slice_scatter(b, a[..., :8], -1, 4, 12), {}, [4, 6, 8]),
    "heads of parts": (by_heads, {}, [2, 3, 6]),
    "heads across parts": (lambda s, a, b, x: cat([a, b], -1).unflatten(-1, (6, 5)).flatten(2), {}, []),
    "shifted in time": (shifted, {}, [4, 6, 12]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_units_of_segments_go_where_they_are_written_and_read(name: str):
    torch.manual_seed(0)
    between, parts, wanted = CASES[name]
    module, x = Joined(between, **parts), torch.randn(1, 3, 4)
    walk = Walk(trace_module(module, [x]))
    groups = {leaf: members for leaf, members in walk.members().items()
              if any((each.weight, each.axis) == ("read.weight", 1) for each in members)}  # fmt: skip
    assert (walk.unknown, sorted(walk.factors.sizes[leaf] for leaf in groups)) == (set(), wanted)
    edits, whole = [], copy.deepcopy(module)
    for leaf, members in groups.items():
        keep = tuple(range(0, walk.factors.sizes[leaf], 2))
        edits.append(Edit("main", members[0].weight, members[0].units, keep))
        for member in members:
            silence(whole, member, set(range(walk.factors.sizes[leaf])) - set(keep))
    small = remove_units(module, [x], edits) if edits else module
    batch = torch.randn(2, 3, 4)
    with torch.no_grad():
        assert_same(small(batch), whole(batch), name)


def test_units_of_a_part_that_nothing_reads_go_too():
    walk = Walk(trace_module(Joined(lambda s, a, b, x: b[..., :5]), [torch.randn(1, 3, 4)]))
    assert sorted(walk.factors.sizes[leaf] for leaf in walk.members()) == [5, 8, 12, 13]


@pytest.mark.parametrize("form", ["cat", "stack"])
def test_an_edit_names_units_of_a_segment(form: str):
    module, x = nn.Sequential(Both(form), nn.Linear(2 * 6, 3)), torch.randn(1, 4)
    units = {member.units: max(member.numbers) + 1 for members in Walk(trace_module(module, [x])).members().values()
             for member in members if member.weight == "1.weight"}  # fmt: skip
    wanted = {"units 1.0.0.0": 6, "units 1.0.1.0": 6} if form == "cat" else {"units 1.1": 6}
    assert units == wanted
    for axis in units:
        read = edits_from(f'[{{"graph": "main", "module": "1.weight", "axis": "{axis}", "keep": [1]}}]', "edits")
        assert remove_units(copy.deepcopy(module), [x], read)(x).shape == (1, 3)
    with pytest.raises(SourceError, match="cannot be chosen"):
        remove_units(module, [x], [Edit("main", "1.weight", "units 1.0.2.0", (0,))])


class Both(nn.Module):
    def __init__(self, form: str):
        super().__init__()
        self.one, self.other, self.form = nn.Linear(4, 6), nn.Linear(4, 6), form

    def forward(self, x: Tensor) -> Tensor:
        both = [self.one(x), self.other(x)]
        return cat(both, 1) if self.form == "cat" else torch.stack(both, 1).flatten(1)


@pytest.mark.parametrize("axis", ["units 0", "units 0.1.2", "units 0.", "units 0.1.2.3.4"])
def test_a_path_that_no_unit_can_have_is_refused(axis: str):
    with pytest.raises(SourceError, match="invalid edit"):
        edits_from(f'[{{"graph": "main", "module": "w", "axis": "{axis}", "keep": [0]}}]', "edits")


def test_what_is_frozen_is_named_by_all_that_keep_it():
    module = Joined(lambda s, a, b, x: s["n"](cat([a, b], -1).cumsum(-1)), n=nn.LayerNorm(30))
    walk = Walk(trace_module(module, [torch.randn(1, 3, 4)]))
    keepers = [set().union(*(names for _, names in walk.terms(product))) for product in range(4)]
    both = {"aten.cumsum", "aten.layer_norm"}
    assert keepers == [{*both, "the policy's inputs"}, {*both, "the policy's inputs"}, both, {"the policy's outputs"}]


def test_work_of_each_segment_is_a_term_of_its_own():
    module = Joined(lambda s, a, b, x: cat([x, a, b], -1))
    walk = Walk(trace_module(module, [torch.randn(1, 3, 4)]))
    sizes = {leaf: walk.factors.sizes[leaf] for leaf in walk.members()}
    terms = walk.terms(2)
    assert sorted((sorted(sizes[leaf] for leaf in leaves), macs) for (leaves, _), macs in terms.items()) == [
        ([8], 3 * 4), ([8, 12], 3), ([8, 18], 3),
    ]  # fmt: skip
    assert {keepers for (leaves, keepers) in terms if len(leaves) == 1} == {frozenset({"the policy's inputs"})}
