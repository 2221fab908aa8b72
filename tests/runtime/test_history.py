"""Inputs that hold several moments: the robot gives one at each control step."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _written import written

from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.episodes.frames import FrameRecorder
from vlatool.errors import DataError, GraphError, PluginError
from vlatool.runtime import ChunkQueue, Policy, load
from vlatool.runtime.control.late import LateController
from vlatool.runtime.image import FrameEncoder

MOMENTS = TensorSpec("x", (1, 3, 2), history=3)
CHUNK = TensorSpec("y", (1, 3, 2))
ECHO = "g (float[1,3,2] x) => (float[1,3,2] y) { y = Identity(x) }"


def echo(folder: Path, text: str = ECHO, inputs: Any = (MOMENTS,), **more: Any) -> Policy:
    """Open a policy whose chunk is the moments that it is given."""
    return load(written(folder, text, inputs, (CHUNK,), chunk=3, **more).path)


def seen(policy: Policy, *numbers: float) -> list[float]:
    """Give the policy moments, infer at the last one, and return the first element of each that the graph was given."""
    for number in numbers[:-1]:
        policy.observe({"x": [number, 0.0]})
    return policy.infer({"x": [numbers[-1], 0.0]}).chunk[:, 0].tolist()


def test_the_last_moments_are_given_oldest_first(tmp_path: Path):
    policy = echo(tmp_path)
    assert seen(policy, 1) == [1, 1, 1]
    assert seen(policy, 2) == [1, 1, 2]
    assert seen(policy, 3, 4, 5) == [3, 4, 5]
    policy.reset()
    assert seen(policy, 7, 8) == [7, 7, 8]


def test_all_moments_may_be_given_and_are_then_the_history(tmp_path: Path):
    policy = echo(tmp_path)
    whole = np.arange(6, dtype=np.float32).reshape(3, 2)
    for given in (whole, whole[None], whole.tolist()):
        np.testing.assert_array_equal(policy.infer({"x": given}).chunk, whole)
    assert seen(policy, 9) == [2, 4, 9]


@pytest.mark.parametrize("value", [np.ones(2), np.ones((1, 2), np.float32), [1, 1]])
def test_a_moment_may_have_the_batch_axis(tmp_path: Path, value):
    np.testing.assert_array_equal(echo(tmp_path).infer({"x": value}).chunk, np.ones((3, 2)))


def test_a_moment_is_kept_as_it_was(tmp_path: Path):
    policy, camera = echo(tmp_path), np.ones(2, np.float32)
    policy.observe({"x": camera})
    camera[:] = 5
    assert policy.infer({"x": camera}).chunk[:, 0].tolist() == [1, 1, 5]
    whole = np.ones((1, 3, 2), np.float32)
    policy.observe({"x": whole})
    whole[:] = 5
    assert seen(policy, 2) == [1, 1, 2]


@pytest.mark.parametrize("value", [np.ones(3), np.ones((2, 2)), [[1, 2], [3]], [np.nan, 0], "left", None])
def test_a_moment_that_does_not_fit_is_refused_and_not_kept(tmp_path: Path, value):
    policy = echo(tmp_path)
    seen(policy, 1)
    for call in (policy.observe, policy.infer):
        with pytest.raises(DataError, match="'x'"):
            call({"x": value})
    assert seen(policy, 2) == [1, 1, 2]


def test_an_inference_that_fails_leaves_the_history(tmp_path: Path):
    policy = echo(tmp_path, "g (float[1,3,2] x) => (float[1,3,2] y) { y = Add(x, x) }")
    seen(policy, 1)
    with pytest.raises(GraphError):
        policy.infer({"x": [3e38, 0]})
    assert seen(policy, 2) == [2, 2, 4]


def test_moments_are_normalised_as_the_whole_is(tmp_path: Path):
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/s.json").write_text('{"x": {"mean": [1, 2], "std": [3, 4]}}')
    normalised = TensorSpec("x", (1, 3, 2), normalisation="mean_std", statistics="s.json#x", history=3)
    policy = echo(tmp_path, inputs=(normalised,))
    rows = np.random.default_rng(0).standard_normal((3, 2)).astype(np.float32)
    whole = policy.infer({"x": rows}).chunk
    policy.reset()
    for row in rows[:2]:
        policy.observe({"x": row})
    np.testing.assert_allclose(policy.infer({"x": rows[2]}).chunk, whole, rtol=1e-6)


def test_inputs_of_one_moment_stay_beside(tmp_path: Path):
    text = "g (float[1,3,2] x, float[1,2] z) => (float[1,3,2] y) { y = Add(x, z) }"
    policy = echo(tmp_path, text, (MOMENTS, TensorSpec("z", (1, 2))))
    policy.observe({"x": [1, 1], "z": [10, 10]})
    assert policy.infer({"x": [2, 2], "z": [20, 20]}).chunk[:, 0].tolist() == [21, 21, 22]


def test_a_robot_observes_in_another_thread_while_its_policy_infers(tmp_path: Path):
    policy = echo(tmp_path)
    begun, observed = threading.Event(), threading.Event()
    run = policy.program.run

    def slow(*arguments: Any) -> Any:
        begun.set()
        assert observed.wait(10)
        return run(*arguments)

    policy.program.run = slow  # type: ignore[method-assign]
    thread = threading.Thread(target=seen, args=(policy, 1))
    thread.start()
    assert begun.wait(10)
    policy.observe({"x": [2, 0]})
    observed.set()
    thread.join()
    assert seen(policy, 3) == [1, 2, 3]


def test_a_policy_without_history_has_nothing_to_observe(tmp_path: Path):
    policy = load(written(tmp_path, "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }").path)
    policy.observe({"anything": None})


@pytest.mark.parametrize("delay", [None, 0, 2])
def test_controllers_give_every_control_step(tmp_path: Path, delay):
    policy = echo(tmp_path)
    controller = ChunkQueue(policy) if delay is None else LateController(policy, delay=delay)
    chunks = []
    for step in range(10):
        action = controller.act({"x": [step, 0]})
        chunks += [[action[0]]] if controller.fresh else []
        if not controller.fresh and len(chunks[-1]) < 3:
            chunks[-1].append(action[0])
    assert chunks[0] == [0, 0, 0]
    if not delay:
        assert chunks[1:3] == [[1, 2, 3], [4, 5, 6]]
    controller.reset()
    assert controller.act({"x": [50, 0]})[0] == 50


class Wrapper:
    """A policy wrapper that was written before there was a history."""

    def __init__(self, policy: Policy) -> None:
        self.spec, self.infer, self.reset = policy.spec, policy.infer, policy.reset


def test_a_wrapper_that_does_not_pass_observations_on_is_refused_where_they_count(tmp_path: Path):
    with pytest.raises(PluginError, match=r"Wrapper has no method observe\(\); its input 'x'"):
        ChunkQueue(Wrapper(echo(tmp_path / "a")))
    plain = load(written(tmp_path / "b", "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }").path)
    assert ChunkQueue(Wrapper(plain)).act({"x": [1, 2]}).tolist() == [-1, -2]


def test_kept_values_and_history_go_together(tmp_path: Path):
    text = """g (float[1,3,2] x, float[1,3,2] h) => (float[1,3,2] y, float[1,3,2] n) {
        n = Add(h, x)  y = Identity(n) }"""
    memory = (ProgramStep("main", {"x": "x", "h": "h"}, {"y": "y", "n": "h"}, keep={"h": {"shape": [1, 3, 2]}}),)
    policy = echo(tmp_path, text, program=memory)
    assert seen(policy, 1, 2) == [1, 1, 2]
    assert seen(policy, 3) == [2, 3, 5]


def test_recorded_frames_hold_what_the_graph_was_given(tmp_path: Path):
    policy = echo(tmp_path / "bundle")
    recorder = FrameRecorder(policy, policy.encode)
    queue = ChunkQueue(recorder, execute=2)
    with recorder.recording(tmp_path / "frames"):
        queue.reset()
        for step in range(6):
            queue.act({"x": [step, 0]})
    frames = np.load(tmp_path / "frames/x.npy")
    assert frames[..., 0].tolist() == [[0, 0, 0], [0, 1, 2], [2, 3, 4]]


SQUARE = {"layout": "hwc", "steps": [{"op": "resize", "size": [4, 6]}], "range": [0, 1]}


def filmed(folder: Path, image: dict[str, Any], channels: int = 3) -> Policy:
    """Open a policy that gives, of each of two moments that it is given, the first pixels' brightness."""
    axes = f"4,6,{channels}" if channels > 1 else "4,6"
    text = (
        f"g (float[1,2,{axes}] x) => (float[1,2,{24 * channels}] y) <int64[3] s = {{1, 2, -1}}> {{ y = Reshape(x, s) }}"
    )
    spec = {"name": "x", "shape": [1, 2, *map(int, axes.split(","))], "history": 2, "image": image}
    return load(
        written(folder, text, (TensorSpec.from_dict(spec),), (TensorSpec("y", (1, 2, 24 * channels)),), chunk=2).path
    )


def grey(brightness: int, *shape: int) -> Any:
    return np.full(shape, brightness, np.uint8)


def test_frames_of_any_size_are_preprocessed_once_and_the_history_holds_them(tmp_path: Path, monkeypatch) -> None:
    policy, calls = filmed(tmp_path, SQUARE), []
    encoded = FrameEncoder.__call__
    monkeypatch.setattr(FrameEncoder, "__call__", lambda self, value: calls.append(value.shape) or encoded(self, value))
    frames = [grey(51, 8, 12, 3), grey(102, 4, 6, 3), grey(153, 40, 30, 3), grey(204, 1, 9, 13, 3)]
    for number, frame in enumerate(frames):
        first, second = policy.infer({"x": frame}).chunk
        np.testing.assert_allclose(first, max(1, number) / 5, rtol=1e-6)
        np.testing.assert_allclose(second, (number + 1) / 5, rtol=1e-6)
    assert calls == [frame.shape for frame in frames]
    policy.reset()
    policy.observe({"x": frames[2]})
    np.testing.assert_allclose(policy.infer({"x": frames[0]}).chunk[:, 0], [0.6, 0.2], rtol=1e-6)


@pytest.mark.parametrize("batch", [(), (1,)])
def test_all_frames_may_be_given_at_once(tmp_path: Path, batch) -> None:
    policy = filmed(tmp_path, SQUARE)
    whole = np.stack([grey(51, 8, 12, 3), grey(255, 8, 12, 3)]).reshape(*batch, 2, 8, 12, 3)
    np.testing.assert_allclose(policy.infer({"x": whole}).chunk[:, 0], [0.2, 1], rtol=1e-6)
    np.testing.assert_allclose(policy.infer({"x": grey(0, 5, 5, 3)}).chunk[:, 0], [1, 0], rtol=1e-6)
    with pytest.raises(DataError, match="given as 3 frames; the policy takes 2"):
        policy.infer({"x": grey(0, 3, 8, 12, 3)})


@pytest.mark.parametrize("shape", [(2, 6), (2, 6, 1), (1, 2, 6), (1, 2, 6, 1)])
def test_a_grey_frame_of_two_rows_is_one_moment(tmp_path: Path, shape) -> None:
    policy = filmed(tmp_path, {**SQUARE, "layout": "hw", "frame": "grey", "channels": "grey"}, 1)
    policy.observe({"x": grey(51, 9, 9)})
    np.testing.assert_allclose(policy.infer({"x": grey(102, *shape)}).chunk[:, 0], [0.2, 0.4], rtol=1e-6)
    np.testing.assert_allclose(policy.infer({"x": grey(204, 2, 9, 9)}).chunk[:, 0], [0.8, 0.8], rtol=1e-6)
    np.testing.assert_allclose(policy.infer({"x": grey(255, 1, 2, 9, 9)}).chunk[:, 0], [1, 1], rtol=1e-6)
    np.testing.assert_allclose(policy.infer({"x": grey(255, 2, 9, 9, 1)}).chunk[:, 0], [1, 1], rtol=1e-6)


@pytest.mark.parametrize("frame", [grey(0, 8, 12, 4), grey(0, 8), np.zeros((8, 12, 3), np.float32), "left", None])
def test_what_is_no_frame_is_refused_and_not_kept(tmp_path: Path, frame) -> None:
    policy = filmed(tmp_path, SQUARE)
    policy.observe({"x": grey(51, 8, 12, 3)})
    with pytest.raises(DataError):
        policy.infer({"x": frame})
    np.testing.assert_allclose(policy.infer({"x": grey(102, 8, 12, 3)}).chunk[:, 0], [0.2, 0.4], rtol=1e-6)
