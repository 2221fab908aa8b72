"""Controllers and wrappers by name: which one plays a policy, and in which order they are put around it."""

from __future__ import annotations

import inspect
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of

from vlatool import registry
from vlatool.errors import PluginError, UsageError
from vlatool.runtime.control import build_controller, layers
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.late import LateController
from vlatool.runtime.interface import Controller, Policy


class Doubled(NumberedPolicy):
    """A wrapper of a policy."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy.spec)
        self.policy = policy

    def infer(self, observation: Any, *, noise: Any = None) -> Any:
        action = self.policy.infer(observation, noise=noise)
        return action._replace(chunk=2 * action.chunk)


class Shifted(Doubled):
    """Another one."""

    def infer(self, observation: Any, *, noise: Any = None) -> Any:
        action = self.policy.infer(observation, noise=noise)
        return action._replace(chunk=action.chunk + 1)


class Negated:
    """A wrapper of a controller."""

    fresh = False

    def __init__(self, controller: Controller) -> None:
        self.controller = controller

    def act(self, observation: Any) -> Any:
        return -self.controller.act(observation)

    def reset(self, seed: int | None = None) -> None:
        self.controller.reset(seed)


class EveryStep(Negated):
    """A controller that asks its policy at every step."""

    def __init__(self, policy: Policy) -> None:
        self.policy = self.controller = policy

    def act(self, observation: Any) -> Any:
        return self.policy.infer(observation).chunk[0]


class Nothing:
    """Neither a policy nor a controller."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy


ADDED = {"doubled": Doubled, "shifted": Shifted, "negated": Negated, "every-step": EveryStep, "nothing": Nothing}


@pytest.fixture(autouse=True)
def _added(monkeypatch: pytest.MonkeyPatch) -> None:
    """The registry finds these classes, too, as it finds those of other packages."""
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda kind, name: ADDED.get(name) or load(kind, name))


def first(names: tuple[str, ...], delay: int = 0) -> list[float]:
    made = build_controller(NumberedPolicy(spec_of(4, 2)), names, delay)
    made.reset(1)
    return [float(made.act({"t": t})[0]) for t in range(6)]


def test_vlatools_own_are_found_by_their_files():
    assert {"chunked", "late"} <= set(registry.names("control"))
    assert {name: registry.load("control", name) for name in ("chunked", "late")} == {
        "chunked": ChunkQueue, "late": LateController}  # fmt: skip


@pytest.mark.parametrize(
    ("names", "delay", "player"),
    [((), 0, ChunkQueue), ((), 1, LateController), (("late",), 0, LateController), (("chunked",), 0, ChunkQueue),
     (("doubled",), 1, LateController), (("every-step",), 0, EveryStep)],
)  # fmt: skip
def test_what_is_not_named_is_chosen_by_the_delay(names: tuple[str, ...], delay: int, player: type):
    assert player in layers(names, delayed=delay > 0)
    assert type(build_controller(NumberedPolicy(spec_of()), names, delay)) is player


def test_wrappers_are_put_around_the_policy_and_the_controller_in_their_order():
    assert first(()) == [0, 1, 200, 201, 400, 401]
    assert first(("doubled", "shifted")) == [1, 3, 401, 403, 801, 803]
    assert first(("shifted", "doubled")) == [2, 4, 402, 404, 802, 804]
    assert first(("negated", "every-step", "doubled")) == [0, -200, -400, -600, -800, -1000]
    assert first(("doubled", "negated"), delay=1) == [0, -2, -4, -402, -404, -406]


@pytest.mark.parametrize(
    ("names", "delayed", "message"),
    [(("lat",), False, "Unknown controller 'lat'; did you mean 'late'"),
     (("chunked", "late"), False, "Both chunked and late play the chunks of the policy"),
     (("every-step",), True, "The controller every-step waits for each inference: its actions cannot come late"),
     (("chunked",), True, "The controller chunked waits for each inference")],
)  # fmt: skip
def test_names_that_make_no_controller_are_refused(names: tuple[str, ...], delayed: bool, message: str):
    with pytest.raises(UsageError, match=message):
        layers(names, delayed=delayed)


def test_an_entry_that_is_neither_is_said():
    with pytest.raises(PluginError, match=r"Nothing, an entry of vlatool.control, lacks methods or properties"):
        build_controller(NumberedPolicy(spec_of()), ("nothing",))


def test_all_of_vlatools_controllers_are_made_of_a_policy_alone():
    for name in {*registry.names("control")} - {"envelope"}:  # which needs the envelope of a robot
        made = build_controller(NumberedPolicy(spec_of(2)), (name,))
        assert isinstance(made, Controller)
        np.testing.assert_array_equal(made.act({"t": 0}), [0, 0.5])
        assert isinstance(inspect.getmodule(type(made)), ModuleType)
        assert Path(inspect.getfile(type(made))).parent.name == "control"
