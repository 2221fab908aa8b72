"""Real-time chunking: seams, chunks that have to last, and what a graph that joins chunks itself is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _delays import Path, scripted
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError, UsageError
from vlatool.runtime.control import build_controller, rtc
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.rtc import RealTimeController
from vlatool.runtime.interface import Controller

ABSOLUTE = replace(MOVES, mode="absolute")


def played(controller: Controller, steps: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the actions (steps, A), and which were the first of a chunk."""
    taken = [(controller.act({"t": t}), controller.fresh) for t in range(steps)]
    return np.stack([action for action, _ in taken]), np.array([fresh for _, fresh in taken])


@pytest.mark.parametrize(("chunk", "execute"), [(1, 0), (4, 0), (8, 3)])
def test_without_delay_and_blending_it_is_the_queue(chunk: int, execute: int):
    queue = ChunkQueue(NumberedPolicy(spec_of(chunk)), execute)
    ours = RealTimeController(NumberedPolicy(spec_of(chunk)), execute, blend=0)
    for one, other in zip(played(queue, 20), played(ours, 20), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("delay", [1, 3, 8])
def test_chunks_that_agree_are_executed_as_they_are(delay: int):
    """The policy knows its path by the time, and a delay of half a chunk or less slows nothing down."""
    controller = RealTimeController(Path(spec_of(16, action=ABSOLUTE)), delay=delay)
    actions, _ = played(controller, 80)
    np.testing.assert_allclose(actions[:, 0], np.sin(np.arange(80) / 20), atol=1e-6)


@pytest.mark.parametrize("mode", ["absolute", "delta", "velocity"])
@pytest.mark.parametrize("delay", [0, 2, 5, 8, 12, 24])
def test_a_seam_jumps_no_more_than_the_inside_of_chunks(mode: str, delay: int):
    policy = Path(spec_of(8, 4, action=replace(MOVES, mode=mode)))
    policy.error = 0.3
    actions, fresh = played(RealTimeController(policy, delay=delay), 400)
    change = np.abs(np.diff(actions[:, 0]))
    assert change[fresh[1:]].mean() < 1.05 * change[~fresh[1:]].mean()
    late = Path(policy.spec)
    late.error = 0.3
    jumps, seams = played(build_controller(late, [f"late:delay={delay}"]), 400)
    assert change[fresh[1:]].max() < 0.7 * np.abs(np.diff(jumps[:, 0]))[seams[1:]].max()


class Homing(NumberedPolicy):
    """Moves to 0 from where it sees the robot, with an error that changes from chunk to chunk."""

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Any:
        action = super().infer(observation, noise=noise)
        way = -float(observation["x"]) * 0.3 * 0.7 ** np.arange(self.spec.chunk) + 0.02 * (-1) ** len(self.asked)
        return action._replace(chunk=np.column_stack([way, np.ones(self.spec.chunk)]).astype(np.float32))


def distances(mode: str, delay: int, share: float, monkeypatch: pytest.MonkeyPatch) -> np.ndarray[Any, Any]:
    """Return how far a robot is from where it should be, late in an episode."""
    monkeypatch.setattr(rtc, "RETURN", share)
    controller = RealTimeController(Homing(spec_of(8, 4, action=replace(MOVES, mode=mode))), delay=delay)
    places = [1.0]
    for step in range(300):
        places.append(places[-1] + controller.act({"t": step, "x": places[-1]})[0])
    return np.abs(places[100:])


@pytest.mark.parametrize("mode", ["delta", "velocity"])
@pytest.mark.parametrize("delay", [4, 8])
def test_what_was_done_otherwise_since_the_observation_is_made_up_for(
    mode: str, delay: int, monkeypatch: pytest.MonkeyPatch
):
    ours, without = (distances(mode, delay, share, monkeypatch) for share in (rtc.RETURN, 0.0))
    assert ours.max() < 0.75 * without.max()


class Stopping(NumberedPolicy):
    """Moves by steps of 1 in its first chunk, and not at all in the next ones."""

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Any:
        action = super().infer(observation, noise=noise)
        return action._replace(chunk=np.full((self.spec.chunk, 2), float(len(self.asked) == 1), np.float32))


def test_a_seam_leads_half_of_the_way_back_without_a_jump(monkeypatch: pytest.MonkeyPatch):
    played_at = {}
    for share in (0.0, 1.0, rtc.RETURN):
        monkeypatch.setattr(rtc, "RETURN", share)
        controller = RealTimeController(Stopping(spec_of(16, 8)), delay=4, blend=8)
        played_at[share] = played(controller, 16)[0][:, 0]
        assert played_at[share][:12].tolist() == [1.0] * 12, "asked again at step 8, and the chunk is there at step 12"
    none, whole, ours = (actions[12:].sum() for actions in played_at.values())
    assert ours == pytest.approx((none + whole) / 2)
    assert np.abs(np.diff(played_at[rtc.RETURN])).max() < 1


class Constant(NumberedPolicy):
    """Moves with the same step of 1 all the time, as long as it is asked."""

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Any:
        action = super().infer(observation, noise=noise)
        return action._replace(chunk=np.tile(np.array([1.0, -1.0], np.float32), (self.spec.chunk, 1)))


@pytest.mark.parametrize("mode", ["delta", "velocity"])
@pytest.mark.parametrize(("delay", "speed"), [(2, 1.0), (4, 1.0), (8, 0.5), (16, 0.25), (24, 1 / 6)])
def test_a_chunk_that_would_not_last_is_executed_more_slowly(mode: str, delay: int, speed: float):
    controller = RealTimeController(Constant(spec_of(8, action=replace(MOVES, mode=mode))), delay=delay)
    actions, _ = played(controller, 200)
    np.testing.assert_allclose(actions[:, 0], speed, rtol=1e-5)
    np.testing.assert_array_equal(actions[:, 1], -1, err_msg="the gripper keeps its command")


def test_a_slower_path_is_the_same_path():
    policy = NumberedPolicy(spec_of(8))
    controller = RealTimeController(policy, delay=8, blend=0)
    controller.act({"t": 0})
    chunk = policy.infer({"t": 0}).chunk[:, 0]
    path = np.concatenate([[0], np.cumsum(chunk)])
    for start, speed in ((0.0, 0.25), (1.75, 0.5), (2.0, 1.0), (0.4, 0.9)):
        steps = np.array(controller._paced(start, speed))[:, 0]
        ends = np.interp([start, start + speed * len(steps)], np.arange(9), path)
        assert ends[1] <= path[-1]
        np.testing.assert_allclose(steps.sum(), np.diff(ends)[0], rtol=0.03)


def test_without_stretching_it_holds_where_nothing_is_left():
    controller = RealTimeController(NumberedPolicy(spec_of(4)), delay=6, stretch=False, blend=0)
    actions, _ = played(controller, 10)
    assert actions[:, 0].tolist() == [0, 1, 2, 3, 0, 0, 0, 103, 0, 0]
    unknown = RealTimeController(NumberedPolicy(spec_of(4, action=replace(MOVES, mode=""))), delay=6, blend=0)
    assert played(unknown, 8)[0][:, 0].tolist() == [0, 1, 2, 3, 3, 3, 3, 103], "nobody says how that is slowed"


def test_labels_are_neither_blended_nor_stretched():
    action = TensorSpec("a", (1, 4, 3), kind="discrete", labels=("l", "r", "f"))

    class Buttons(NumberedPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Any:
            return super().infer(observation)._replace(chunk=np.array([2, 0, 1, 2]))

    controller = RealTimeController(Buttons(spec_of(4, action=action)), delay=3)
    actions, _ = played(controller, 9)
    assert actions.shape == (9,)
    assert set(actions.tolist()) <= {0, 1, 2}


def test_a_delay_that_grows_is_bridged_after_it_was_seen_once():
    policy = Constant(spec_of(8))
    controller = scripted(RealTimeController(policy, memory=2), [2, 2, 12, 12, 12, 12, 2])
    actions, _ = played(controller, 120)
    stopped = actions[:, 0] == 0
    assert stopped.sum() > 0
    assert not stopped[40:].any()
    np.testing.assert_allclose(actions[-20:, 0], 1, rtol=1e-5, err_msg="the long ones are forgotten")


def test_relative_actions_of_two_states_are_not_blended():
    controller = RealTimeController(NumberedPolicy(spec_of(8, 4, action=replace(MOVES, mode="relative"))), delay=0)
    assert played(controller, 6)[0][:, 0].tolist() == [0, 1, 2, 3, 400, 401]


GUIDES = (
    TensorSpec("prev_chunk_left_over", (1, 6, 2)),
    TensorSpec("inference_delay", (1,), dtype="int64"),
    TensorSpec("execution_horizon", (), dtype="int64"),
)


class Guided(NumberedPolicy):
    """Keeps what it is given."""

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        self.given: list[Mapping[str, Any]] = []

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Any:
        self.given.append(observation)
        return super().infer(observation, noise=noise)


def guided_spec(action: TensorSpec = ABSOLUTE, guides: tuple[TensorSpec, ...] = GUIDES) -> PolicySpec:
    return PolicySpec((TensorSpec("t", (1, 1)), *guides), (action,), 20, 6, 3)


def test_a_graph_that_joins_chunks_is_given_the_rest_of_the_last_one():
    policy = Guided(guided_spec())
    controller = RealTimeController(policy, delay=2)
    actions, _ = played(controller, 8)
    first, second = policy.given[:2]
    assert first["prev_chunk_left_over"].shape == (1, 6, 2)
    assert [int(first[name].item()) for name in ("inference_delay", "execution_horizon")] == [0, 0]
    rest = second["prev_chunk_left_over"][0, :, 0]
    assert rest.tolist() == [3, 4, 5, 5, 5, 5], "asked at step 3; padded by holding"
    assert [int(second[name].item()) for name in ("inference_delay", "execution_horizon")] == [2, 3]
    assert (second["inference_delay"].shape, second["execution_horizon"].shape) == ((1,), ())
    assert second["inference_delay"].dtype == np.int64
    assert actions[5:7, 0].tolist() == [302, 303], "its chunk is executed as it is"
    assert actions[:5, 0].tolist() == [0, 1, 2, 3, 4]
    assert set(second) == {"t", *(tensor.name for tensor in GUIDES)}


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (guided_spec(guides=GUIDES[1:]), "takes execution_horizon, inference_delay; a graph that joins"),
        (guided_spec(guides=(TensorSpec("prev_chunk_left_over", (1, 5, 2)), *GUIDES[1:])), "wanted: continuous"),
    ],
)
def test_guides_that_do_not_fit_are_refused(spec: PolicySpec, message: str):
    with pytest.raises(SpecError, match=message):
        RealTimeController(Guided(spec))


@pytest.mark.parametrize("arguments", [{"blend": -1}, {"blend": 0.5}, {"delay": -3}])
def test_numbers_out_of_range_are_refused(arguments: Mapping[str, Any]):
    with pytest.raises(UsageError, match="allowed: a whole number from"):
        RealTimeController(NumberedPolicy(spec_of(4)), **arguments)
