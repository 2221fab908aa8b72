"""Whatever wraps a policy is a policy or a controller, and they compose in any order."""

from __future__ import annotations

import inspect
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of

from vlatool.episodes.controls import Blind
from vlatool.episodes.disturbances import DELAY, DROPPED_FRAMES, DisturbedController
from vlatool.episodes.frames import FrameRecorder, Noisy
from vlatool.runtime import ChunkQueue, load
from vlatool.runtime.control.late import LateController
from vlatool.runtime.interface import CHUNK, HOLD, POLICY, Action, Controller, Origin, Policy, origin_of
from vlatool.runtime.observation import EncodedObservation
from vlatool.runtime.policy import BundlePolicy

SPEC = spec_of(4, 2)
ANSWERS = np.array([[0.0, 1.0], [0.5, 3.0]], np.float32)
POLICIES = (BundlePolicy, FrameRecorder, NumberedPolicy)
CONTROLLERS = (ChunkQueue, LateController, Noisy, DisturbedController, Blind)


class Steps:
    """An encoder that leaves the observation as it is."""

    names = ("t",)

    def __call__(self, observation: Any) -> EncodedObservation:
        return EncodedObservation({"t": np.atleast_1d(observation["t"])})


@pytest.mark.parametrize(("protocol", "made"), [*itertools.product([Policy], POLICIES),
                                                *itertools.product([Controller], CONTROLLERS)])  # fmt: skip
def test_methods_take_what_the_protocol_says(protocol: type, made: type):
    for name in ("infer", "act", "reset"):
        if hasattr(protocol, name):
            wanted, own = (inspect.signature(getattr(each, name)).parameters.values() for each in (protocol, made))
            assert [(one.name, one.kind, one.default) for one in own] == [
                (one.name, one.kind, one.default) for one in wanted]  # fmt: skip


def test_an_open_bundle_is_a_policy_and_gives_actions(float_bundle, observation):
    policy = load(float_bundle.path, threads=1)
    assert isinstance(policy, Policy)
    assert not isinstance(policy, Controller)
    action = policy.infer(observation)
    assert isinstance(action, Action)
    assert action.origin() == Origin(POLICY, action.latency_ms)


WRAPPERS = (
    lambda inner: DisturbedController(inner, SPEC, DROPPED_FRAMES, 2.0),
    lambda inner: DisturbedController(inner, SPEC, DELAY, 1.0),
    lambda inner: Noisy(inner, SPEC.action, 0.1, ANSWERS),
)


@pytest.mark.parametrize("order", [*itertools.permutations(range(3))], ids=str)
@pytest.mark.parametrize("player", [ChunkQueue, LateController])
def test_wrappers_compose_in_any_order(order: tuple[int, ...], player: Any, tmp_path: Path):
    policy = NumberedPolicy(SPEC)
    recorder = FrameRecorder(FrameRecorder(policy, Steps()), Steps())
    assert isinstance(recorder, Policy)
    acting: Controller = player(recorder)
    for index in order:
        acting = WRAPPERS[index](acting)
        assert isinstance(acting, Controller)
    episodes = []
    for _ in range(2):
        acting.reset(3)
        episodes.append([(acting.act({"t": t}).tolist(), acting.fresh) for t in range(12)])
        assert origin_of(acting).source == POLICY
        assert origin_of(acting).age_ms > 0
    assert episodes[0] == episodes[1], "the seed decides all that is drawn"
    assert policy.seeds == [3, 3]
    with recorder.recording(tmp_path / "frames"):
        acting.reset(3)
        for t in range(12):
            acting.act({"t": t})
    half = len(policy.asked) // 3
    np.testing.assert_array_equal(np.load(tmp_path / "frames/t.npy"), policy.asked[-half:])


def test_a_blind_controller_draws_by_the_seed_of_the_episode():
    blind = Blind("random", SPEC.action, ANSWERS)
    drawn = []
    for seed in (1, 2, 1):
        blind.reset(seed)
        drawn.append([blind.act({}).tolist() for _ in range(20)])
    assert drawn[0] == drawn[2] != drawn[1]


def test_a_controller_that_does_not_say_where_its_action_comes_from_claims_nothing():
    assert origin_of(Blind("constant", SPEC.action, ANSWERS)) == Origin("", None, ())


def test_a_wrapper_extends_where_an_action_comes_from():
    assert Origin(HOLD, 3.0, ("speed",)).altered_by("jerk", "stop") == Origin(HOLD, 3.0, ("speed", "jerk", "stop"))
    assert Action(ANSWERS, (), 1.0, 0, {}, CHUNK, 4.0, ("speed",)).origin(2.5) == Origin(CHUNK, 6.5, ("speed",))
