"""Controllers and wrappers by name: which one plays a policy, and in which order they are put around it."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool import registry
from vlatool.bundle.spec import PolicySpec, TensorSpec
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


class Tuned(Doubled):
    """A wrapper with options."""

    def __init__(
        self, policy: Policy, *, spec: PolicySpec, gain: float = 1.0, steps: int | None = None, on: bool = False,
        word: str = "", table: dict[str, int] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(policy)
        self.given = (spec, gain, steps, on, word, table)


class Nothing:
    """Neither a policy nor a controller."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy


ADDED = {"doubled": Doubled, "shifted": Shifted, "negated": Negated, "every-step": EveryStep, "nothing": Nothing,
         "tuned": Tuned}  # fmt: skip


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
     (("rtc", "rtc"), False, "The controller rtc is named twice"),
     (("rtc:blend=1", "shifted", "rtc:blend=2"), False, "The controller rtc is named twice"),
     (("shifted", "shifted"), False, "The controller shifted is named twice"),
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
    place = TensorSpec("place", (1, 2), labels=MOVES.labels)
    spec = PolicySpec((*spec_of().inputs, place), (MOVES,), 20, 2)
    for name in {*registry.names("control")} - {"envelope", "zero_noise", "dual_rate"}:  # not of this policy
        made = build_controller(NumberedPolicy(spec), (name,))
        assert isinstance(made, Controller)
        np.testing.assert_array_equal(made.act({"t": 0, "place": np.zeros(2)}), [0, 0.5])
        assert isinstance(inspect.getmodule(type(made)), ModuleType)
        assert Path(inspect.getfile(type(made))).parent.name == "control"


def given(name: str) -> tuple[Any, ...]:
    controller: Any = build_controller(NumberedPolicy(spec_of(4, 2)), (name,))
    tuned: Tuned = controller.policy
    assert tuned.given[0] == spec_of(4, 2)
    return tuned.given[1:]


def test_options_follow_the_name():
    assert given("tuned") == (1.0, None, False, "", None)
    assert given("tuned:gain=2:steps=3:on=true:word=a=b") == (2.0, 3, True, "a=b", None)
    assert given("tuned:gain=1e-3") == (1e-3, None, False, "", None)
    assert first(("late:delay=1",)) == first(("late",), delay=1)
    assert first(("doubled", "late:delay=1", "negated")) == first(("negated", "doubled"), delay=1)


@pytest.mark.parametrize(
    ("name", "delayed", "message"),
    [("tuned:gian=1", False, "has no option 'gian'; did you mean 'gain'"), ("tuned:gain", False, "gives gain no value"),
     ("tuned:policy=1", False, "has no option 'policy'"), ("tuned:spec=1", False, "has no option 'spec'"),
     ("tuned:table=1", False, "has no option 'table'"), ("tuned:", False, "has no option ''"),
     ("tuned:gain=1:gain=2", False, "gives gain twice"), ("tuned:gain=nan", False, "gain is 'nan'; allowed: a number"),
     ("tuned:gain=", False, "gain is ''; allowed"), ("tuned:steps=1.5", False, "steps is '1.5'; allowed: a whole"),
     ("tuned:on=1", False, "on is '1'; allowed: true or false"), ("chunked:delay=1", False, "has no option 'delay'"),
     ("late:delay=1", True, "The delay of late is given, and it is that of the latency"),
     ("chunked:execute=2", True, "The controller chunked waits for each inference")],
)  # fmt: skip
def test_options_that_are_none_are_refused(name: str, delayed: bool, message: str):
    with pytest.raises(UsageError, match=re.escape(message)):
        layers((name,), delayed=delayed)
