"""The controller that keeps actions in an envelope: seams, resets, swaps, the start, readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from _numbered import EchoController

from vlatool import registry
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, UsageError
from vlatool.runtime.control import layers
from vlatool.runtime.control.envelope import EnvelopeController
from vlatool.runtime.envelope import Envelope, JointLimits, Level, Monitor, RobotLimits, envelope_of
from vlatool.runtime.interface import Controller, Origin

T = 0.02
PAIR = RobotLimits("pair", tuple(JointLimits(name, "m", 0.0, 1.0, (-0.5, 0.5), 2.0, 40.0) for name in "xy"))


class Clock:
    """Goes on by a period at each reading."""

    now = 0.0

    def __call__(self) -> float:
        self.now += T
        return self.now


def bounded(**options: Any) -> EnvelopeController:
    envelope = Envelope(PAIR, T, clock=Clock(), **options)
    return EnvelopeController(EchoController("action"), envelope, position="state")


def see(*action: float, state: tuple[float, float] = (0.5, 0.5), **more: Any) -> dict[str, Any]:
    return {"action": np.array(action, np.float32), "state": np.array([state], np.float32), **more}


def test_it_is_found_by_name_and_wraps_a_controller():
    assert registry.load("control", "envelope") is EnvelopeController
    assert layers(["envelope"])[-1] is EnvelopeController
    assert isinstance(bounded(), Controller)
    with pytest.raises(UsageError, match="its envelope is NoneType"):
        EnvelopeController(EchoController("action"))


def test_an_action_inside_is_the_controllers_own_array():
    controller = bounded()
    observation = see(0.5001, 0.5)
    action = controller.act(observation)
    assert action.dtype == np.float32
    np.testing.assert_array_equal(action, observation["action"])
    assert controller.result is not None
    assert controller.result.checks == ()
    assert controller.fresh


def test_it_starts_where_the_robot_is_measured_or_not_at_all():
    for observation, message in (
        (see(0.5, 0.5, state=(1.2, 0.5)), "x is at 1.2; its limits are 0 to 1"),
        ({"action": np.zeros(2)}, "The observation has no 'state'"),
        (see(0.5, 0.5, state=(np.nan, 0.5)), "The start position is"),
    ):
        with pytest.raises(DataError, match=message):
            bounded().act(observation)
    unmeasured = EnvelopeController(EchoController("action"), Envelope(PAIR, T))
    with pytest.raises(DataError, match="The start position is None"):
        unmeasured.act(see(0.5, 0.5))
    measured = EnvelopeController(EchoController("action"), Envelope(PAIR, T), position=lambda seen: seen["state"][0])
    measured.act(see(0.5, 0.5))


def test_the_state_survives_seams_resets_and_another_controller():
    controller = bounded()
    last = 0.5
    for step in range(30):
        last += 0.008 * min(1.0, step / 25) ** 2
        controller.act(see(last, 0.5))
    controller.reset(3)
    controller.controller = EchoController("action")
    action = controller.act(see(0.9, 0.5))  # a new episode that knows nothing of the last position
    assert controller.result is not None
    assert controller.result.checks == ("discontinuity",)
    assert 0 < action[0] - last < 0.01, "it goes on along its stop"
    before = action[0]
    for _ in range(40):
        action = controller.stop()
    assert action[0] - before < 0.06
    np.testing.assert_array_equal(controller.stop(), action)


def test_readings_are_taken_from_the_observation_or_from_a_function():
    monitor = Monitor("obstacle", 1.0, 0.5)
    controller = bounded(monitors=(monitor,))
    controller.act(see(0.5, 0.5, obstacle=np.array([2.0])))
    assert controller.result is not None
    assert controller.result.level is Level.SAFE
    controller.act(see(0.5, 0.5))
    assert controller.result.checks == ("obstacle",), "no reading"
    envelope = Envelope(PAIR, T, monitors=(monitor,), dead_man=True, clock=Clock())
    controller = EnvelopeController(
        EchoController("action"), envelope, position="state", readings=lambda _: {"obstacle": 2.0}, enabled=lambda: True
    )
    controller.act(see(0.5, 0.5))
    assert controller.result is not None
    assert controller.result.checks == ()


def test_the_age_that_a_controller_says_is_checked_and_the_origin_passed_on():
    controller = bounded(max_age_s=0.1)
    controller.act(see(0.5, 0.5))
    assert controller.result is not None
    assert controller.result.checks == ("fresh",), "nobody says an age"
    inner: Any = controller.controller
    inner.origin = Origin("policy", 50.0)
    controller.act(see(0.5001, 0.5))
    assert controller.origin == Origin("policy", 50.0)
    controller.act(see(0.51, 0.5))
    assert controller.origin.checks == controller.result.checks
    inner.origin = Origin("chunk", 150.0, ("other",))
    controller.act(see(0.51, 0.5))
    assert controller.origin == Origin("stop", 150.0, ("other", "fresh"))


def spec(hz: float | None = 50.0, **changes: Any) -> PolicySpec:
    values = {"name": "a", "shape": (1, 1, 2), "labels": ("y", "x"), "mode": "absolute", "unit": "m"} | changes
    return PolicySpec((TensorSpec("s", (1, 1)),), (TensorSpec(**values),), hz)


def test_an_envelope_takes_mode_order_and_rate_from_the_spec():
    envelope = envelope_of(spec(), PAIR)
    assert (envelope.mode, envelope.period_s) == ("absolute", 0.02)
    assert [joint.name for joint in envelope.limits.joints] == ["y", "x"]
    assert envelope_of(spec(mode="velocity", unit="m/s", labels=("a", "b")), PAIR).limits is PAIR


@pytest.mark.parametrize(("changes", "message"), [
    ({"mode": ""}, "mode 'not stated'"), ({"mode": "relative"}, "mode 'relative'"), ({"hz": None}, "at which rate"),
    ({"unit": "deg"}, "The action gives y in deg; its limits are in m"), ({"mode": "velocity"}, "limits are in m/s"),
    ({"shape": (1, 1, 3), "labels": ()}, "has 3 elements; 'pair' has 2 joints: x, y"),
    ({"kind": "discrete"}, "is discrete"),
])  # fmt: skip
def test_an_action_that_does_not_fit_the_limits_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        envelope_of(spec(**changes), PAIR)


@pytest.mark.parametrize("options", [
    {"mode": "relative"}, {"near": 0.0}, {"near": np.inf}, {"max_age_s": -1.0}, {"max_interval_s": np.nan},
    {"monitors": (Monitor("a", 1, 2), Monitor("a", 1, 2))}, {"monitors": (Monitor("a", 1, 2, joints=("z",)),)},
])  # fmt: skip
def test_an_envelope_of_absurd_arguments_is_refused(options: dict[str, Any]):
    with pytest.raises(UsageError):
        Envelope(PAIR, T, **options)
    for period in (0.0, -1.0, np.nan, np.inf, "20 ms"):
        with pytest.raises(UsageError):
            Envelope(PAIR, period)  # type: ignore[arg-type]


@pytest.mark.parametrize("bands", [
    {"warning": 1.0, "critical": 1.0}, {"warning": np.nan, "critical": 1.0},
    {"warning": 1.0, "critical": 2.0, "emergency": 1.5},
    {"warning": 2.0, "critical": 1.0, "emergency": 1.5}, {"warning": 1.0, "critical": 2.0, "slowest": 1.1},
    {"warning": "1", "critical": 2.0},
])  # fmt: skip
def test_bands_out_of_order_are_refused(bands: dict[str, Any]):
    with pytest.raises(UsageError, match=r"The monitor r has the bands"):
        Monitor("r", **bands)


@pytest.mark.parametrize("switch", [False, np.False_, None, 0, "off", np.array(False), float("nan"), 1 / 3], ids=repr)
def test_a_dead_mans_switch_that_does_not_say_true_stops_the_robot(switch: Any):
    controller = EnvelopeController(
        EchoController("action"), Envelope(PAIR, T, clock=Clock()), position="state", enabled=lambda: switch
    )
    assert controller.act(see(0.5001, 0.5)).tolist() == [0.5, 0.5]
    envelope = Envelope(PAIR, T)
    envelope.start([0.5, 0.5])
    checks = envelope.step([0.5001, 0.5], elapsed_s=T, enabled=switch).checks
    assert checks == (() if switch is None else ("dead-man",)), "None: there is no switch"


@pytest.mark.parametrize("switch", [True, np.True_, np.float64(2) > 1], ids=repr)
def test_a_dead_mans_switch_that_is_held_may_be_numpys(switch: Any):
    envelope = Envelope(PAIR, T, dead_man=True)
    envelope.start([0.5, 0.5])
    assert envelope.step([0.5001, 0.5], elapsed_s=T, enabled=switch).checks == ()


def test_a_switch_or_readings_that_raise_stop_the_robot():
    def broken(*_: Any) -> Any:
        raise OSError("no bus")

    monitor = Monitor("distance", warning=1.0, critical=0.4)
    for options, check in (({"enabled": broken}, "dead-man"), ({"readings": broken}, "distance")):
        envelope = Envelope(PAIR, T, clock=Clock(), monitors=[monitor] * ("readings" in options))
        controller = EnvelopeController(EchoController("action"), envelope, position="state", **options)
        assert controller.act(see(0.5001, 0.5)).tolist() == [0.5, 0.5]
        assert controller.result is not None
        assert controller.result.checks == (check,)
        assert controller.stop().tolist() == [0.5, 0.5]


def test_the_robot_starts_at_the_newest_of_several_moments():
    for state in ([[0.1, 0.2], [0.5, 0.6]], [[[0.1, 0.2], [0.5, 0.6]]]):
        controller = bounded()
        controller.act({"action": np.array([0.5, 0.6]), "state": np.array(state)})
        assert controller.envelope.position == (0.5, 0.6)
    for state in ([0.5, 0.6, 0.0, 0.0], ["a", "b"], "here", []):
        with pytest.raises(DataError, match="The start position is"):
            bounded().act({"action": np.array([0.5, 0.6]), "state": state})


@pytest.mark.parametrize("dtype", [object, np.longdouble, np.complex128], ids=str)
def test_an_array_that_is_refused_is_never_given_back(dtype: Any):
    controller = bounded()
    action = controller.act({"action": np.array([0.5, 0.5], dtype), "state": np.array([0.5, 0.5])})
    assert action.dtype == np.float64
