"""Zeros in the place of the noise that a policy draws."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.program import ProgramStep
from vlatool.errors import UsageError
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.action_check import CheckedPolicy
from vlatool.runtime.control.zero_noise import ZeroNoise


class Drawing(NumberedPolicy):
    """Draws noise of two names."""

    def __init__(self) -> None:
        super().__init__(spec_of(4, 2))
        shapes = {"x": [1, 2], "y": [3]}
        steps = [ProgramStep(name, {}, {}, noise={name: {"shape": shape}}) for name, shape in shapes.items()]
        self.program = SimpleNamespace(steps=steps)
        self.given: list[Any] = []

    def infer(self, observation: Any, *, noise: Any = None) -> Any:
        self.given.append({name: value.tolist() for name, value in noise.items()})
        return super().infer(observation)


@pytest.mark.parametrize(
    "around", [lambda policy: policy, CheckedPolicy, lambda policy: CheckedPolicy(ZeroNoise(policy))]
)
def test_every_noise_is_zero_unless_the_caller_has_one(around: Any):
    policy = Drawing()
    zero = ZeroNoise(around(policy))
    zero.infer({"t": 0})
    zero.infer({"t": 1}, noise={"y": np.ones(3, np.float32)})
    assert policy.given == [{"x": [[0, 0]], "y": [0, 0, 0]}, {"x": [[0, 0]], "y": [1, 1, 1]}]
    zero.reset(3)
    assert policy.seeds == [3]


@pytest.mark.parametrize("player", ["chunked", "late", "rtc", "asynchronous"])
def test_every_player_takes_it(player: str):
    policy = Drawing()
    build_controller(policy, [player, "zero_noise"]).act({"t": 0})
    assert policy.given == [{"x": [[0, 0]], "y": [0, 0, 0]}]


def test_a_policy_without_noise_is_refused():
    with pytest.raises(UsageError, match="draws no noise"):
        ZeroNoise(NumberedPolicy(spec_of()))
