"""Commands in another order, of another sign or unit, told by the joints that follow them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vlatool.verify._commands import best_change
from vlatool.verify._model import Model
from vlatool.verify._reading import Names
from vlatool.verify._search import KINDS
from vlatool.verify._series import Array, Series

JOINTS, STEPS, LEAD = 5, 60, 2
NEEDED = {name: dict.fromkeys(KINDS, 10.0) for name in ("joints", "action")}


def series(seeds: range) -> Series:
    """An arm that follows another: joints alike in mean and spread, and where the other stands two steps ahead."""
    values: dict[str, list[Array]] = {"joints": [], "action": []}
    for seed in seeds:
        random = np.random.default_rng(seed)
        speed = np.repeat(random.normal(0, 0.02, ((STEPS + LEAD) // 4 + 1, JOINTS)), 4, axis=0)[: STEPS + LEAD]
        path = np.cumsum(speed, axis=0)
        values["joints"].append(path[:STEPS] + random.normal(0, 2e-4, (STEPS, JOINTS)))
        values["action"].append(path[LEAD:] + random.normal(0, 2e-3, (STEPS, JOINTS)))
    numbers = np.repeat(np.arange(len(seeds)), STEPS)
    return Series({name: np.concatenate(each) for name, each in values.items()}, numbers, numbers % 4)


@pytest.fixture(scope="module")
def model() -> Model:
    names = Names(("joints",), (), "action")
    return replace(Model.of(names, series(range(12)), discrete=False), needed=NEEDED)


def changed(change: Array) -> Series:
    return series(range(50, 52)).with_signals(("action",), lambda values: values @ change)


def test_right_commands_are_right(model):
    assert best_change(model, series(range(50, 52))).components == ()


@pytest.mark.parametrize("order", [[1, 0, 2, 3, 4], [1, 2, 3, 4, 0], [4, 3, 1, 2, 0]])
def test_an_order_is_found_whole(model, order):
    finding = best_change(model, changed(np.eye(JOINTS)[:, order]))
    assert finding.fix.order == tuple(order)
    assert {each.kind for each in finding.components} == {"permuted"}


def test_signs_and_units_that_are_too_small_are_found(model):
    signs = np.array([1, -1, 1, -1, 1.0])
    assert best_change(model, changed(np.diag(signs))).fix.signs == (1, -1, 1, -1, 1)
    finding = best_change(model, changed(np.diag([1, 1, 1e-3, 1e-3, 1])))
    np.testing.assert_allclose(finding.fix.factors, [1, 1, 1e-3, 1e-3, 1])


def test_commands_are_not_divided(model):
    finding = best_change(model, changed(np.diag([1, 1, 1, 1, 1e3])))
    assert max(finding.fix.factors) == 1


def test_what_has_too_little_for_it_is_left_out(model):
    high = replace(model, needed={name: dict.fromkeys(KINDS, 1e6) for name in NEEDED})
    finding = best_change(high, changed(np.eye(JOINTS)[:, [1, 0, 2, 3, 4]]))
    assert (finding.components, finding.fix.order) == ((), tuple(range(JOINTS)))
