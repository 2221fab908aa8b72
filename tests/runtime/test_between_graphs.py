"""What only one graph gives another stays where it was computed: a cache of keys and values is not copied each step."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

from vlatool.bundle.program import ProgramStep
from vlatool.errors import GraphError
from vlatool.runtime.engines._device_tensors import DeviceTensor
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.program import Program, leave_between_graphs

CACHE = "float[1,300,512]"
"""Larger than what goes through bound buffers."""
PREFILL = f"""g (float[1,4] x) => ({CACHE} keys, float[1,4] token)
    <float one = {{1}}, int64[3] shape = {{1, 300, 512}}> {{
    mean = ReduceMean <keepdims = 0> (x) keys = Expand(mean, shape) token = Add(x, one) }}"""
DECODE = f"""g ({CACHE} keys, float[1,4] token) => ({CACHE} keys_next, float[1,4] token_next, float[1,4] action) {{
    mean = ReduceMean <keepdims = 0> (keys) moved = Mul(token, mean) token_next = Tanh(moved)
    part = ReduceMean <keepdims = 0> (token_next) keys_next = Add(keys, part) action = Identity(token_next) }}"""
ENDLESS = f"""g ({CACHE} keys) => ({CACHE} after) <int64 n = {{4611686018427387904}}, bool go = {{1}}> {{
    after = Loop (n, go, keys) <body = b (int64 i, bool on, {CACHE} v) => (bool more, {CACHE} w) {{
        more = Identity(on) w = Tanh(v) }}> }}"""
SMALL = "g (float[1,4] token) => (float[1,4] action) { action = Neg(token) }"
STEPS = (
    ProgramStep("prefill", {"x": "x"}, {"keys": "keys", "token": "token"}),
    ProgramStep(
        "decode",
        {"keys": "keys", "token": "token"},
        {"keys_next": "later", "token_next": "next", "action": "action"},
        repeat=3,
        carry={"later": "keys", "next": "token"},
    ),
)


@pytest.fixture
def sessions(tmp_path: Path) -> dict[str, OrtCpuSession]:
    def opened(name: str, text: str) -> OrtCpuSession:
        model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}')
        onnx.save(model, str(tmp_path / f"{name}.onnx"))
        return OrtCpuSession(tmp_path / f"{name}.onnx", 1)

    graphs = {"prefill": PREFILL, "decode": DECODE, "endless": ENDLESS, "small": SMALL}
    return {name: opened(name, text) for name, text in graphs.items()}


def chosen(sessions: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: sessions[name] for name in names}


def values(seed: int = 0) -> dict[str, Any]:
    return {"x": np.random.default_rng(seed).normal(size=(1, 4)).astype(np.float32)}


def test_a_cache_stays_and_the_actions_are_the_same(sessions, monkeypatch):
    two = chosen(sessions, "prefill", "decode")
    expected = [Program(STEPS, two).run(values(seed))["action"] for seed in range(3)]
    program = Program(STEPS, two, outputs=["action"])

    def copied(*_given: Any) -> Any:
        raise AssertionError("a tensor between graphs was copied to the host")

    monkeypatch.setattr(DeviceTensor, "__array__", copied)
    got = [program.run(values(seed)) for seed in range(3)]
    for run, action in zip(got, expected, strict=True):
        np.testing.assert_array_equal(run["action"], action)
        assert isinstance(run["action"], np.ndarray)
        assert isinstance(run["keys"], DeviceTensor)


def test_what_stays_is_not_changed_by_later_runs(sessions):
    program = Program(STEPS, chosen(sessions, "prefill", "decode"), outputs=["action"])
    first = program.run(values(0))
    before = np.array(first["keys"])
    program.run(values(1))
    np.testing.assert_array_equal(np.array(first["keys"]), before)


@pytest.mark.parametrize(
    ("outputs", "steps"),
    [
        (["action", "later"], STEPS),  # the caller takes it
        (["action", "keys"], STEPS),  # what is carried into a value that the caller takes
        (["action"], (STEPS[0], ProgramStep("decode", STEPS[1].feeds, STEPS[1].gives | {"keys_next": "keys"},
                                            keep={"keys": {"shape": [1, 300, 512]}}))),  # kept for the next inference
    ],
)  # fmt: skip
def test_what_the_host_needs_is_an_array(sessions, outputs, steps):
    two = chosen(sessions, "prefill", "decode")
    got = Program(steps, two, outputs=outputs).run(values())
    for name in (*outputs, *(name for step in steps for name in step.keep)):
        assert isinstance(got[name], np.ndarray), name
    assert not two["decode"]._stays.get("keys_next")


def test_a_graph_of_small_tensors_takes_what_another_left(sessions):
    steps = (STEPS[0], ProgramStep("small", {"token": "token"}, {"action": "action"}))
    two = chosen(sessions, "prefill", "small")
    expected = Program(steps, two).run(values())["action"]
    program = Program(steps, two, outputs=["action"])
    assert sessions["small"].bound
    assert two["prefill"]._stays == {"keys": False, "token": True}
    np.testing.assert_array_equal(program.run(values())["action"], expected)


def test_an_output_that_two_steps_give_stays_only_where_both_may(sessions):
    again = ProgramStep("prefill", {"x": "x"}, {"token": "action", "keys": "keys"})
    session = sessions["prefill"]
    leave_between_graphs((STEPS[0], again, STEPS[1]), {"prefill": session}, ["action"])
    assert session._stays == {"keys": True, "token": False}


def test_a_deadline_stops_a_graph_whose_tensors_stay(sessions):
    steps = (STEPS[0], ProgramStep("endless", {"keys": "keys"}, {"after": "action"}))
    program = Program(steps, chosen(sessions, "prefill", "endless"), outputs=["action"])
    sessions["endless"].deadline = time.monotonic() + 0.2
    with pytest.raises(TimeoutError):
        program.run(values())
    sessions["endless"].deadline = None


def test_scalars_and_views_are_fed_as_they_are(tmp_path: Path):
    text = f"""g (float[] scale, float[4,4] x) => ({CACHE} keys, float[4,4] y) <int64[3] shape = {{1, 300, 512}}> {{
        y = Mul(x, scale) keys = Expand(scale, shape) }}"""
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}')
    onnx.save(model, str(tmp_path / "graph.onnx"))
    session = OrtCpuSession(tmp_path / "graph.onnx", 1)
    feeds = {"scale": np.array(2, np.float32), "x": np.arange(32, dtype=np.float32).reshape(4, 8)[:, ::2].T}
    expected = session.run(feeds)
    session.leave_on_device({"keys"}, ())
    for _ in range(20):
        got = session.run(feeds)
        np.testing.assert_array_equal(got["y"], expected["y"])
    np.testing.assert_array_equal(np.asarray(got["keys"]), expected["keys"])


def test_a_wrong_feed_is_named_as_ever(sessions):
    program = Program(STEPS, chosen(sessions, "prefill", "decode"), outputs=["action"])
    with pytest.raises(GraphError, match=r"prefill\.onnx"):
        program.run({"x": np.zeros((1, 5), np.float32)})
