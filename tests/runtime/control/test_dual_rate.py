"""Policies of two systems: a fast part that never waits for the slow one, on values of a bounded age."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from _fake_clock import FakeClock
from _numbered import NumberedPolicy, spec_of
from _two_systems import observations, two_systems, written_graphs

from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError, DeadlineMissed, GraphError, UsageError
from vlatool.runtime import Policy, load
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.action_check import CheckedPolicy
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.control.dual_rate import DualRate
from vlatool.runtime.replay import replay
from vlatool.runtime.stack import Fallback, build_stack
from vlatool.runtime.telemetry.cadence import Cadence
from vlatool.runtime.two_parts import parts_of

LONG_MS = 20_000.0


def opened(seed: int = 0) -> Policy:
    return Policy.open(two_systems(), threads=1, seed=seed)


class Held:
    """A session whose runs begin when they may, and fail or give NaN where they are told to."""

    def __init__(self, session: Any) -> None:
        self.session, self.go, self.began = session, threading.Event(), threading.Event()
        self.error: Exception | None = None
        self.spoiled = False
        self.runs = 0
        self.go.set()

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        self.runs += 1
        self.began.set()
        assert self.go.wait(20)
        if self.error is not None:
            raise self.error
        outputs = self.session.run(feeds)
        return {**outputs, "thought": outputs["thought"] * np.nan} if self.spoiled else outputs


def held(**options: Any) -> tuple[DualRate, Held]:
    """A policy with a slow part in a thread, which waits for the test."""
    policy = opened()
    slow = policy.program.sessions["think"] = Held(policy.program.sessions["think"])
    return DualRate(policy, thread=True, hz=0, **options), slow


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def plain_loop(episode: list[dict[str, np.ndarray]], every: int, late: int, seed: int = 0) -> list[np.ndarray]:
    """The chunks of a loop that is written down with bare ONNX Runtime."""
    bundle = two_systems()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    graphs = {name: onnxruntime.InferenceSession(str(bundle.file(graph.file)), options)
              for name, graph in bundle.manifest.graphs.items()}  # fmt: skip
    random, memory, chunks = np.random.default_rng(seed), np.zeros((1, 16), np.float32), []
    used, coming = None, None
    for number, seen in enumerate(episode):
        if number % every == 0:
            thought, memory = graphs["think"].run(["thought", "next"], {"scene": seen["scene"][None], "memory": memory})
            coming = number, thought
        if coming is not None and (used is None or number - coming[0] >= late):
            used, coming = coming[1], None
        x = random.standard_normal((1, 4, 2), np.float32)
        for t in (1.0, 0.75, 0.5, 0.25):
            numbers = {"t": np.array([t], np.float32), "dt": np.array([-0.25], np.float32)}
            (x,) = graphs["act"].run(["next"], {"thought": used, "state": seen["state"][None], "x": x, **numbers})
        chunks.append(x[0])
    return chunks


@pytest.mark.parametrize(("every", "late"), [(1, 0), (4, 0), (4, 3), (0, 0), (3, 1)])
def test_at_every_kth_inference_it_computes_what_a_plain_loop_does(every: int, late: int):
    dual, episode = DualRate(opened(), every, late=late), observations(12)
    for _ in range(2):
        actions = [dual.infer(seen) for seen in episode]
        for action, chunk in zip(actions, plain_loop(episode, every or 4, late), strict=True):
            np.testing.assert_array_equal(action.chunk, chunk)
        dual.reset()
    assert [action.sequence for action in actions] == list(range(12))
    if (every, late) == (0, 0):
        assert [action.latent_age_ms for action in actions[:6]] == [0, 10, 20, 30, 0, 10], "planned time at 100 Hz"


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_both_parts_at_each_inference_are_the_whole_policy(engine: str):
    policies = [Policy.open(two_systems(), engine=engine, threads=1, seed=0) for _ in range(2)]
    whole, dual = policies[0], DualRate(policies[1], 1)
    for seen in observations(5):
        wanted, action = whole.infer(seen), dual.infer(seen)
        np.testing.assert_array_equal(action.chunk, wanted.chunk)
        np.testing.assert_array_equal(action.outputs["action"], wanted.outputs["action"])
    assert (whole.infer(seen).latent_age_ms, dual.infer(seen).latent_age_ms) == (None, 0)


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_both_parts_at_once_compute_what_they_do_in_turns(engine: str):
    """Each chunk beside the thread is that of one of the values that the slow part gives in turn, for one scene."""
    policies = [Policy.open(two_systems(), engine=engine, threads=1, seed=0) for _ in range(2)]
    dual = DualRate(policies[0], thread=True, hz=0, max_age_ms=LONG_MS)
    slow, fast = parts_of(policies[1])
    scene = observations(1)[0]["scene"]
    thoughts = [slow.run({"scene": scene}) for _ in range(70)]

    def chunk_of(thought: Mapping[str, Any], seen: Mapping[str, Any], before: Any) -> np.ndarray[Any, Any]:
        fast.restore(before)
        fast.latent = thought
        return fast.infer(seen).chunk

    for seen in observations(60):
        chunk, before = dual.infer({**seen, "scene": scene}).chunk, fast.snapshot
        assert any(np.array_equal(chunk_of(thought, seen, before), chunk) for thought in thoughts)
    dual.close()


def test_the_fast_part_goes_on_while_the_slow_one_runs():
    """The slow part ends when the test lets it, ten inferences later."""
    dual, slow = held(max_age_ms=LONG_MS)
    episode, chunks = observations(30), plain_loop(observations(30), 1000, 0)
    for number, seen in enumerate(episode[:20]):
        if number == 1:
            slow.go.clear()
            slow.began.clear()
        np.testing.assert_array_equal(dual.infer(seen).chunk, chunks[number])
    assert slow.began.wait(20)
    assert slow.runs == 2, "one run at a time"
    ages = [dual.infer(seen).latent_age_ms for seen in episode[20:22]]
    assert ages[0] < ages[1]
    slow.go.set()
    until(lambda: not dual._rhythm._worker.busy)
    fresh = dual.infer(episode[22])
    assert (fresh.chunk != chunks[22]).any()
    dual.close()


def test_values_that_are_too_old_are_not_used_and_the_ladder_answers():
    clock = FakeClock()
    dual, slow = held(clock=clock)
    stack = build_stack(dual, fallback=Fallback(misses=3, hold_s=10), clock=clock)
    episode, sources = observations(40), []
    for number, seen in enumerate(episode[:30]):
        if number == 1:
            slow.go.clear()
        stack.act(seen)
        sources.append(stack.origin.source)
        age = stack.origin.latent_age_ms
        assert age is None or stack.origin.source == "chunk" or age <= 100
        clock.now += 0.01
    assert sources[:13] == ["policy"] * 11 + ["chunk", "chunk"]
    assert set(sources[13:]) == {"hold"}
    assert "allowed: 100 ms" in str(stack.ladder.error) or "was stopped" in str(stack.ladder.error)
    slow.go.set()
    for seen in episode[30:]:
        until(lambda: not dual._rhythm._worker.busy)
        stack.act(seen)
        clock.now += 0.01
    assert stack.origin.source == "policy", "it has recovered"
    assert stack.origin.latent_age_ms <= 20
    stack.close()


def test_a_run_that_takes_longer_than_its_values_may_be_old_is_stopped():
    clock = FakeClock()
    dual, slow = held(clock=clock)
    (first, second, third, *_), stops = observations(4), []
    dual.infer(first)
    slow.go.clear()
    slow.began.clear()
    slow.stop = lambda: stops.append(slow.go.set())
    dual.infer(second)
    assert slow.began.wait(20)
    clock.now += 0.101
    with pytest.raises(DeadlineMissed, match="longer than its values may be old, 100 ms: it was stopped"):
        dual.infer(third)
    assert stops
    dual.close()


@pytest.mark.parametrize("error", [GraphError("no such kernel"), RuntimeError("cable")])
def test_what_the_slow_part_raises_is_raised_once_and_its_last_values_are_used_until_they_are_old(error: Exception):
    dual, slow = held(max_age_ms=LONG_MS)
    episode = observations(6)
    chunks = plain_loop([episode[0], episode[1], episode[3]], 1000, 0)
    dual.infer(episode[0])
    slow.error = error
    dual.infer(episode[1])
    until(lambda: not dual._rhythm._worker.busy)
    slow.go.clear()
    with pytest.raises(type(error), match=r"The slow part: no such kernel|cable"):
        dual.infer(episode[2])
    np.testing.assert_array_equal(dual.infer(episode[3]).chunk, chunks[2])
    slow.error = None
    slow.go.set()
    dual.close()


def test_values_that_are_not_finite_never_reach_the_fast_part():
    dual, slow = held(max_age_ms=LONG_MS)
    slow.spoiled = True
    for seen in observations(3):
        with pytest.raises(GraphError, match="The slow part: The value of the slow part 'thought' is not finite"):
            dual.infer(seen)
    slow.spoiled = False
    assert np.isfinite(dual.infer(seen).chunk).all()
    dual.close()


def test_an_observation_without_what_the_slow_part_takes_is_its_error():
    dual, _ = held(max_age_ms=LONG_MS)
    with pytest.raises(DataError, match="The slow part: The observation has no 'scene'"):
        dual.infer({"state": [0, 0]})
    dual.infer({"state": [0, 0], "scene": [1, 2, 3]})
    dual.close()


@pytest.mark.parametrize("options", [{"every": 4}, {"thread": True, "max_age_ms": LONG_MS}])
def test_a_reset_forgets_the_values_the_memory_and_the_noise(options: dict[str, Any]):
    dual, episode = DualRate(opened(), **options), observations(5)
    first = dual.infer(episode[0]).chunk
    for seen in episode:
        dual.infer(seen)
    dual.reset()
    np.testing.assert_array_equal(dual.infer(episode[0]).chunk, first)
    dual.reset(7)
    np.testing.assert_array_equal(dual.infer(episode[0]).chunk, plain_loop(episode[:1], 1, 0, seed=7)[0])
    dual.close()


def test_a_reset_while_the_slow_part_runs_uses_nothing_of_that_run():
    dual, slow = held(max_age_ms=LONG_MS)
    episode = observations(4)
    first = dual.infer(episode[0]).chunk
    slow.go.clear()
    slow.began.clear()
    dual.infer(episode[1])
    assert slow.began.wait(20)
    dual.reset()
    threading.Timer(0.05, slow.go.set).start()
    np.testing.assert_array_equal(dual.infer(episode[0]).chunk, first)
    dual.close()


def test_a_deadline_ends_the_wait_for_the_first_values_and_not_the_slow_part():
    dual, slow = held(max_age_ms=LONG_MS)
    slow.go.clear()
    deadline, episode = Deadline(dual, 30.0), observations(3)
    for seen in episode[:2]:
        with pytest.raises(DeadlineMissed):
            deadline.infer(seen)
        until(lambda: not deadline.busy)
    assert slow.runs == 1, "the first run goes on"
    slow.go.set()
    until(lambda: not dual._rhythm._worker.busy)
    deadline.deadline_ms = LONG_MS
    first_noise = plain_loop([{**episode[0], "state": episode[2]["state"]}], 1, 0)
    np.testing.assert_array_equal(deadline.infer(episode[2]).chunk, first_noise[0])
    deadline.close()
    dual.close()


def test_a_late_inference_is_taken_back_with_the_slow_part_that_ran_for_it():
    policy = opened()
    fast = policy.program.sessions["act"] = Held(policy.program.sessions["act"])
    dual = DualRate(policy, 2)
    deadline, episode = Deadline(dual, LONG_MS), observations(4)
    chunks = plain_loop([episode[0], *episode[2:]], 2, 0)
    np.testing.assert_array_equal(deadline.infer(episode[0]).chunk, chunks[0])
    fast.go.clear()
    deadline.deadline_ms = 30.0
    with pytest.raises(DeadlineMissed):
        deadline.infer(episode[1])
    fast.go.set()
    until(lambda: not deadline.busy)
    deadline.deadline_ms = LONG_MS
    for seen, chunk in zip(episode[2:], chunks[1:], strict=True):
        np.testing.assert_array_equal(deadline.infer(seen).chunk, chunk)
    deadline.close()


def test_a_stack_runs_the_slow_part_in_a_thread_and_its_report_has_the_age_of_the_values():
    cadence = Cadence(20)
    stack = load(two_systems().path, threads=1, seed=0, deadline_ms=None, telemetry=cadence)
    (dual,) = [layer for layer in stack.layers if isinstance(layer, DualRate)]
    assert dual.thread
    for seen in observations(10):
        stack.act(seen)
    assert stack.origin.latent_age_ms > 0
    stack.close()
    latent = cadence.report().latent
    assert latent is not None
    assert (latent.part, latent.steps) == ("latent age", 10)
    assert dual._rhythm._worker._thread is None, "closed"


def test_a_run_is_recorded_with_the_slow_part_at_every_kth_inference(tmp_path: Path):
    path, bundle = tmp_path / "run", two_systems()
    with pytest.raises(UsageError, match="runs in a thread of its own") as caught:
        load(bundle.path, threads=1, seed=0, record=path)
    assert "dual_rate:every=4" in caught.value.fix
    stack = load(bundle.path, threads=1, seed=0, record=path, controllers=["dual_rate:every=4"])
    chunks = plain_loop(observations(9), 4, 0)
    for seen, chunk in zip(observations(9), chunks, strict=True):
        np.testing.assert_array_equal(stack.act(seen), chunk[0])
    stack.close()
    result = replay(path, bundle.path)
    assert (result.steps, result.equal) == (9, True)


ENDLESS_THOUGHT = """g (float[1,2] scene) => (float[1,2] thought)
    <int64 trips = {4611686018427387904}, bool go = {1}, float zero = {0}> {
        m = ReduceMax<keepdims = 0>(scene)  go_on = Greater(m, zero)
        thought = Loop (trips, go_on, scene) <body = b (int64 i, bool c, float[1,2] a) => (bool d, float[1,2] e) {
            d = Identity(c)
            e = Neg(a)
        }>
    }"""
"""Ends at once where no element is above 0."""
ADDED = "g (float[1,2] thought, float[1,2] state) => (float[1,2] action) { action = Add(thought, state) }"


def test_a_slow_graph_without_end_is_stopped_in_the_engine_and_the_policy_lives_on(tmp_path: Path):
    slow = {"max_age_ms": 40.0}
    steps = (ProgramStep("think", {"scene": "scene"}, {"thought": "thought"}, slow=slow),
             ProgramStep("act", {"thought": "thought", "state": "state"}, {"action": "action"}))  # fmt: skip
    bundle = written_graphs(tmp_path, {"think": ENDLESS_THOUGHT, "act": ADDED}, steps,
                            (TensorSpec("scene", (1, 2)), TensorSpec("state", (1, 2))))  # fmt: skip
    dual = DualRate(Policy.open(bundle, threads=1), thread=True)
    dual.resume()
    for _ in range(3):
        with pytest.raises(DeadlineMissed, match="it was stopped"):
            dual.infer({"scene": [1, 1], "state": [0, 0]})
        until(lambda: not dual._rhythm._worker.busy)
    assert dual.infer({"scene": [-1, -1], "state": [2, 3]}).chunk.tolist() == [[1, 2]]
    dual.close()


@pytest.mark.parametrize("options", [{"every": 2}, {"thread": True, "hz": 0, "max_age_ms": LONG_MS}])
def test_earlier_moments_of_what_the_slow_part_takes_come_from_every_control_step(
    tmp_path: Path, options: dict[str, Any]
):
    text = """g (float[1,3,2] scene) => (float[1,2] thought) <int64[1] a = {1}> {
        thought = ReduceSum<keepdims = 0>(scene, a) }"""
    steps = (ProgramStep("think", {"scene": "scene"}, {"thought": "thought"}, slow={"max_age_ms": 200.0}),
             ProgramStep("act", {"thought": "thought", "state": "state"}, {"action": "action"}))  # fmt: skip
    bundle = written_graphs(tmp_path, {"think": text, "act": ADDED}, steps,
                            (TensorSpec("scene", (1, 3, 2), history=3), TensorSpec("state", (1, 2))))  # fmt: skip
    dual = DualRate(Policy.open(bundle, threads=1), **options)
    assert dual.infer({"scene": [1, 1], "state": [0, 0]}).chunk.tolist() == [[3, 3]]
    dual.observe({"scene": [10, 10], "state": [0, 0]})
    until(lambda: not options.get("thread") or not dual._rhythm._worker.busy)
    assert dual.infer({"scene": [5, 5], "state": [7, 7]}).chunk.tolist() == [[10, 10]]
    until(lambda: not options.get("thread") or not dual._rhythm._worker.busy)
    seen = dual.infer({"scene": [20, 20], "state": [0, 0]}).chunk.tolist()
    assert seen == ([[16, 16]] if options.get("thread") else [[35, 35]])
    dual.close()


@pytest.mark.soak("test_the_fast_part_goes_on_while_the_slow_one_runs")
def test_the_fast_part_answers_in_its_time_while_the_slow_one_takes_ten_times_as_long():
    """Two seconds at 100 Hz; the slow part takes ten periods."""

    class Sleeping(Held):
        def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
            time.sleep(0.1)
            return super().run(feeds)

    policy = opened()
    slow = policy.program.sessions["think"] = Sleeping(policy.program.sessions["think"])
    stack = build_stack(policy, controllers=["dual_rate:thread=true:max_age_ms=300:hz=0"], deadline_ms=10.0,
                        fallback=Fallback(start=[0, 0]))  # fmt: skip
    late, ages, sources = 0, [], []
    begin = time.monotonic()
    for number, seen in enumerate(observations(200)):
        time.sleep(max(0.0, begin + number / 100 - time.monotonic()))
        called = time.monotonic()
        stack.act(seen)
        late += time.monotonic() - called > 0.012
        sources.append(stack.origin.source)
        ages.append(stack.origin.latent_age_ms)
    assert late <= 4
    assert sources[20:].count("policy") >= 170
    assert 15 <= slow.runs <= 21
    assert all(age is None or age <= 350 for age in ages)
    stack.close()


def test_an_evaluation_plays_it_by_name():
    controller, episode = build_controller(opened(), ["dual_rate:every=4:late=2"]), observations(9)
    for seen, chunk in zip(episode, plain_loop(episode, 4, 2), strict=True):
        np.testing.assert_array_equal(controller.act(seen), chunk[0])
    assert controller.origin.latent_age_ms is not None


@pytest.mark.parametrize("player", ["chunked", "late:delay=1", "asynchronous:delay=1", "rtc", "temporal_ensemble"])
def test_every_player_says_how_old_the_values_are(player: str):
    controller = build_controller(opened(), ["dual_rate:every=4", player])
    ages = []
    for seen in observations(6):
        controller.act(seen)
        ages.append(controller.origin.latent_age_ms)
    assert None not in ages
    assert max(ages) > 15


def test_noise_of_the_caller_goes_to_the_part_that_draws_it():
    dual, seen, noise = DualRate(opened(), 1), observations(1)[0], {"x": np.zeros((1, 4, 2), np.float32)}
    np.testing.assert_array_equal(dual.infer(seen, noise=noise).chunk, opened().infer(seen, noise=noise).chunk)
    with pytest.raises(DataError, match="draws no noise 'y'"):
        dual.infer(seen, noise={"y": noise["x"]})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"every": -1}, "every"),
        ({"every": 2, "late": 3}, "late is 3"),
        ({"every": 4, "thread": True}, "without a thread"),
        ({"every": 12}, "110 ms after their observation; allowed: 100 ms"),
        ({"max_age_ms": 0}, "max_age_ms"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], words: str):
    with pytest.raises(UsageError, match=words):
        DualRate(opened(), **options)


def test_a_policy_without_a_slow_part_or_in_a_wrapper_is_refused():
    with pytest.raises(UsageError, match="no step of its program says 'slow'"):
        DualRate(NumberedPolicy(spec_of(2)))
    with pytest.raises(UsageError, match="cannot be around CheckedPolicy"):
        DualRate(CheckedPolicy(opened()))
