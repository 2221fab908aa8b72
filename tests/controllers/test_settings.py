"""No setting of any controller may be a number that switches a check off."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from vlatool.controllers.roi_tracker import RoiTracker
from vlatool.errors import UsageError
from vlatool.registry import load, names

NUMBERS = [
    (name, entry.name)
    for name in names("controllers")
    for entry in dataclasses.fields(load("controllers", name))
    if entry.init and isinstance(entry.default, float)
]


@pytest.mark.parametrize(("controller", "setting"), NUMBERS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_setting_that_is_not_finite_is_refused(controller: str, setting: str, value: float) -> None:
    kind: Any = load("controllers", controller)
    with pytest.raises(UsageError, match=rf"{setting} is -?(nan|inf)"):
        kind(**{setting: value})


@pytest.mark.parametrize("text", ["²,1,2,3", "1,1,0,3", "1,1,00,3", "1,2,3", "a,1,2,3", "1,1,99999999999,3"])
def test_a_region_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="allowed: X,Y,WIDTH,HEIGHT"):
        RoiTracker(roi=text)
