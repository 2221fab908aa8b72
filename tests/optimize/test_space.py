"""What may be pruned of a policy, found by trying, and what a trial of it is made of."""

from __future__ import annotations

from typing import Any

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.optimize.plan import transforms
from vlatool.optimize.recipe import Pruning
from vlatool.optimize.space import FLOAT32, Shape, Space, quantizations, space_of
from vlatool.prune.depth import Depth
from vlatool.stage.base import Context


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages run without a child of their own."""
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))


RECOVER: Any = ({"distill.policy": {}},)
INT8: Any = ({"quantize.static_int8": {}},)
WIDTHS = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)


def space(blocks: int = 3, steps: int = 10, widths: tuple[float, ...] = WIDTHS) -> Space:
    return Space(widths, blocks, steps, {"static_int8": INT8, FLOAT32: ()}, RECOVER)


def test_the_first_trials_are_the_whole_policy_each_way_alone_and_all_of_them() -> None:
    assert list(space().first()) == [
        Shape(1.0, 3, 10, "static_int8"),
        Shape(1.0, 3, 1, "static_int8"),
        Shape(0.55, 3, 10, "static_int8"),
        Shape(1.0, 2, 10, "static_int8"),
        Shape(0.55, 2, 1, "static_int8"),
    ]


def test_what_cannot_be_pruned_is_not_among_the_first_trials() -> None:
    assert list(space(blocks=1, steps=1).first()) == [
        Shape(1.0, 1, 1, "static_int8"),
        Shape(0.55, 1, 1, "static_int8"),
    ]


def test_a_shape_becomes_stages_in_the_order_in_which_they_can_follow_each_other() -> None:
    stages = space().stages(Shape(0.4, 1, 2, "static_int8"))
    assert [next(iter(stage)) for stage in stages] == [
        "prune.steps", "prune.depth", "prune.structured", "distill.policy", "quantize.static_int8"
    ]  # fmt: skip
    assert stages[0] == {"prune.steps": {"to": 2}}
    assert stages[2] == {"prune.structured": {"ratio": 0.6}}
    assert space().name(Shape(0.4, 1, 2, "static_int8")) == "steps2_blocks1_width40_static_int8"


def test_nothing_is_trained_where_nothing_is_pruned() -> None:
    whole = Shape(1.0, 3, 10, FLOAT32)
    assert space().is_whole(whole)
    assert space().stages(whole) == ()
    assert space().name(whole) == "whole_float32"


@pytest.mark.parametrize("size", range(2, 40))
def test_as_many_blocks_go_as_the_shape_says(size: int) -> None:
    for left in range(1, size):
        ((_, options),) = [
            next(iter(stage.items())) for stage in space(blocks=size).stages(Shape(1.0, left, 10, FLOAT32))[:1]
        ]
        assert size - Depth(**options)._removal_count(size) == left


def test_only_quantization_of_the_whole_policy_that_names_no_layer_is_tried_on_pruned_ones() -> None:
    given: Any = {
        "static_int8": INT8,
        "mixed": ({"quantize.static_int8": {"exclude": ["head"]}},),
        "smaller": ({"prune.depth": {}}, {"distill.policy": {}}, *INT8),
        "none": (),
    }
    assert quantizations(given) == {"static_int8": INT8}


def test_the_space_of_a_policy_is_found_by_trying(source_bundle: Bundle, tmp_path) -> None:
    found = space_of(source_bundle, Pruning(trials=3), {"static_int8": INT8, FLOAT32: ()}, tmp_path, Context())
    assert (found.widths, found.blocks, found.steps) == (WIDTHS[:3], 1, 1), "44.5 % of its work may go"
    assert all(found.holds(shape) for shape in found.first())
    assert not found.holds(Shape(0.5, 1, 1, FLOAT32))
    for shape in found.first():
        transforms(found.stages(shape))


def test_a_policy_of_which_nothing_can_be_pruned_is_refused_with_the_reasons(
    source_bundle: Bundle, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(self: Any, *_: Any) -> None:
        raise RecipeError(f"{self.name()} finds nothing")

    monkeypatch.setattr("vlatool.module.stage.ModuleStage.check", refused)
    with pytest.raises(RecipeError, match=r"Nothing of tiny can be pruned.*prune\.structured finds nothing.*depth"):
        space_of(source_bundle, Pruning(trials=3), {FLOAT32: ()}, tmp_path, Context())
