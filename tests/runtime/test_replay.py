"""A recorded run is computed again bit by bit, whatever was late, and the first difference is named."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _written import written

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError, DeadlineMissed, UsageError
from vlatool.runtime import load
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.control.envelope import EnvelopeController
from vlatool.runtime.envelope import JointLimits, RobotLimits, envelope_of
from vlatool.runtime.interface import layers_of
from vlatool.runtime.replay import replay
from vlatool.runtime.stack import Fallback, Stack, build_stack
from vlatool.runtime.telemetry.recorder import Recorder
from vlatool.runtime.telemetry.replay import ReplayResult
from vlatool.runtime.telemetry.run_file import MAGIC, Frame, FrameKind, RunHeader, RunWriter, read_run

LABELS = ("x", "z")
POSE = TensorSpec("x", (1, 2), labels=LABELS)
NOISY = """g (float[1,2] x, float[1,6,2] n, float[1,2] h) => (float[1,6,2] y, float[1,2] m)
    <float[1] small = {0.001}, int64[1] one = {1}> {
        m = Add(h, x)  far = Unsqueeze(m, one)  drawn = Mul(n, small)  y = Add(far, drawn) }"""
"""A policy with noise, which keeps a sum from inference to inference."""


def bundle_of(folder: Path) -> Bundle:
    """Write the policy."""
    step = ProgramStep(
        "main", {"x": "x", "n": "n", "h": "h"}, {"y": "y", "m": "h"}, keep={"h": {"shape": [1, 2]}},
        noise={"n": {"shape": [1, 6, 2], "distribution": "normal"}},
    )  # fmt: skip
    action = TensorSpec("y", (1, 6, 2), labels=LABELS, mode="absolute")
    return written(folder, NOISY, (POSE,), (action,), (step,), chunk=6, execute=2)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bundle_of(tmp_path_factory.mktemp("replayed") / "bundle").path


def enveloped(controller: Any) -> EnvelopeController:
    axis = {"unit": "", "low": -9.0, "high": 9.0, "velocity": (-1.0, 1.0), "acceleration": 4.0, "jerk": 80.0}
    limits = RobotLimits("table", tuple(JointLimits(name, **axis) for name in LABELS))
    envelope = envelope_of(layers_of(controller)[-1].spec, limits)
    return EnvelopeController(controller, envelope, position="x")


def run(bundle: Path, file: Path, steps: int = 30, late: bool = True, **more: Any) -> list[Any]:
    """Record control steps, of which some miss their deadline; return the actions."""
    stack = load(bundle, threads=1, seed=None, record=file, **{"deadline_ms": 90, **more})
    assert isinstance(stack, Stack)
    random, actions = np.random.default_rng(0), []
    for deadline in stack.deadlines:
        deadline.infer = lateness(deadline.infer, random) if late else deadline.infer  # type: ignore[method-assign]
    for step in range(steps):
        try:
            actions.append(
                stack.act({"x": random.normal(0, 1e-3, 2).astype(np.float32), "words": "go on", "unused": [1, 2]})
            )
        except DeadlineMissed:
            actions.append(None)
        if step in (11, 19):
            stack.reset(None if step == 11 else 7)
    stack.close()
    return actions


def lateness(infer: Any, random: np.random.Generator) -> Any:
    """Return an ``infer`` of which a third misses its deadline, as the engine is stopped."""

    def late(observation: Any, *, noise: Any = None) -> Any:
        if random.random() < 0.3:
            raise DeadlineMissed("There is no action within 90 ms: it was stopped.")
        return infer(observation, noise=noise)

    return late


@pytest.mark.parametrize(
    "more",
    [{}, {"deadline_ms": None, "controllers": ["late:delay=2"]}, {"controllers": ["rtc:delay=3"]},
     {"controllers": ["temporal_ensemble", "interpolation:factor=2"], "deadline_ms": 40},
     {"fallback": Fallback(max_age_ms=5.0, hold_s=0.2, recover=2, misses=2)},
     {"controllers": ["asynchronous:delay=2"]},
     {"controllers": ["deadline:deadline_ms=40"], "deadline_ms": None, "fallback": Fallback()}],
    ids=["deadline", "late", "rtc", "ensemble", "fallback", "asynchronous", "named"],
)  # fmt: skip
def test_a_run_is_computed_again_bit_by_bit(bundle: Path, tmp_path: Path, more: dict[str, Any]):
    actions = run(bundle, tmp_path / "run", **more)
    frames = [frame for frame in read_run(tmp_path / "run") if frame.kind is FrameKind.TICK]
    for frame, action in zip(frames, actions, strict=True):
        if action is not None:
            assert frame.arrays["action"].tobytes() == action.tobytes()
    misses = sum("late" in answer for frame in frames for answer in frame.values["answers"])
    assert (misses > 0) is (more.get("controllers") != ["late:delay=2"])
    assert replay(tmp_path / "run", bundle) == ReplayResult(30, True, None, "")


def test_a_second_bundle_and_an_envelope_are_replayed_too(bundle: Path, tmp_path: Path):
    other = bundle_of(tmp_path / "other").path
    run(bundle, tmp_path / "run", fallback=other, envelope=enveloped)
    with pytest.raises(DataError, match="within an envelope that a function put around"):
        replay(tmp_path / "run", bundle)
    for again in (other, None):
        assert replay(tmp_path / "run", bundle, fallback=again, envelope=enveloped) == ReplayResult(30, True, None, "")


def test_what_is_done_to_an_envelope_between_steps_is_replayed(bundle: Path, tmp_path: Path):
    stack: Any = load(bundle, threads=1, record=tmp_path / "run", envelope=enveloped)
    envelope = stack.controller.envelope
    envelope.start([0.01, 0.02])
    for step in range(40):
        stack.act({"x": np.zeros(2)})
        if step == 5:
            envelope.emergency("button")
        if step == 30 and envelope.at_rest():
            envelope.clear()
    stack.close()
    assert replay(tmp_path / "run", bundle, envelope=enveloped) == ReplayResult(40, True, None, "")
    calls = [frame.values["name"] for frame in read_run(tmp_path / "run") if frame.kind is FrameKind.CALL]
    assert calls[:2] == ["start", "emergency"]


def changed(path: Path, target: Path, step: int, edit: Any) -> Path:
    """Write a recording again, with right checksums, in which an edit was done to a control step."""
    writer = RunWriter(target)
    for frame in read_run(path):
        arrays = {name: array.copy() for name, array in frame.arrays.items()}
        if frame.kind is FrameKind.TICK and frame.values["step"] == step:
            edit(frame.values, arrays)
        writer.append(Frame(frame.kind, frame.values, arrays))
    writer.close()
    return target


def bit(name: str, index: tuple[int, ...]) -> Any:
    def edit(values: Any, arrays: Any) -> None:
        arrays[name][index] = np.nextafter(arrays[name][index], np.float32(9))

    return edit


def moved(values: Any, arrays: Any) -> None:
    arrays["seen.x"][0] += 1


def pop(*names: str) -> Any:
    def edit(values: Any, arrays: Any) -> None:
        (arrays if names[0] in arrays else values).pop(names[0])

    return edit


@pytest.mark.parametrize(
    ("step", "edit", "expected"),
    [(3, bit("action", (1,)), ("action", (1,))), (0, bit("output.0.y", (0, 4, 1)), ("y", (0, 4, 1))),
     (6, bit("chunk.0", (5, 0)), ("chunk", (5, 0))), (2, moved, ("y", (0, 0, 0))),
     (4, lambda values, arrays: values["clock"].append(1.0), ("clock", ())),
     (4, lambda values, arrays: values["clock"].clear(), ("clock", ())),
     (2, lambda values, arrays: values["answers"].clear(), ("inference", ())),
     (3, lambda values, arrays: values["answers"].append({"policy": 0, "late": True}), ("inference", ())),
     (5, lambda values, arrays: values.update(error="GraphError: x"), ("error", ())),
     (5, lambda values, arrays: arrays.update(action=np.zeros(3)), ("action", ()))],
    ids=range(10),
)  # fmt: skip
def test_the_first_difference_is_named(bundle: Path, tmp_path: Path, step: int, edit: Any, expected: Any):
    run(bundle, tmp_path / "run", 8, late=False)
    found = replay(changed(tmp_path / "run", tmp_path / "changed", step, edit), bundle)
    assert not found.equal
    assert found.difference is not None
    assert (found.difference.step, found.difference.output, found.difference.element) == (step, *expected)
    assert found.difference.recorded != found.difference.replayed


def test_another_noise_is_a_difference(bundle: Path, tmp_path: Path):
    run(bundle, tmp_path / "run", 3, late=False)
    writer = RunWriter(tmp_path / "changed")
    for frame in read_run(tmp_path / "run"):
        values = {**frame.values, "seed": 5} if frame.kind is FrameKind.HEADER else frame.values
        writer.append(Frame(frame.kind, values, frame.arrays))
    writer.close()
    difference = replay(tmp_path / "changed", bundle).difference
    assert difference is not None
    assert (difference.step, difference.output) == (0, "y")


@pytest.mark.parametrize(
    "edit", [pop("clock"), pop("answers"), pop("texts"), pop("chunk.0"), pop("output.0.y"), pop("action")], ids=range(6)
)
def test_a_frame_that_lacks_something_is_refused_or_a_difference(bundle: Path, tmp_path: Path, edit: Any):
    run(bundle, tmp_path / "run", 3, late=False)
    path = changed(tmp_path / "run", tmp_path / "changed", 2, edit)
    with contextlib.suppress(DataError):
        assert not replay(path, bundle).equal


@pytest.mark.parametrize(("name", "value"), [("policy", None), ("seed", "x"), ("controllers", 5), ("threads", [1])])
def test_a_header_that_is_none_is_refused(bundle: Path, tmp_path: Path, name: str, value: Any):
    run(bundle, tmp_path / "run", 1)
    header = next(read_run(tmp_path / "run")).values
    writer = RunWriter(tmp_path / "changed")
    writer.append(Frame(FrameKind.HEADER, {**header, name: value}, {}))
    writer.close()
    with pytest.raises(DataError, match=f"its header is wrong.*{name}"):
        replay(tmp_path / "changed", bundle)


def test_another_bundle_is_refused(bundle: Path, tmp_path: Path):
    run(bundle, tmp_path / "run", 1)
    action = TensorSpec("y", (1, 2), labels=LABELS, mode="absolute")
    other = written(tmp_path / "neg", "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", (POSE,), (action,))
    with pytest.raises(DataError, match="recorded with another bundle"):
        replay(tmp_path / "run", other.path)


def test_a_recording_that_was_cut_is_replayed_as_far_as_it_goes(bundle: Path, tmp_path: Path):
    run(bundle, tmp_path / "run", 6)
    content = (tmp_path / "run").read_bytes()
    (tmp_path / "cut").write_bytes(content[: len(content) * 2 // 3])
    found = replay(tmp_path / "cut", bundle)
    assert found.equal
    assert 0 < found.steps < 6
    assert "cut off" in found.note


def test_a_file_is_bounded_and_says_what_is_missing(tmp_path: Path):
    recorder = Recorder(tmp_path / "run", max_bytes=20_000)
    recorder.begin_run(RunHeader("", "ort_cpu", 1, 0))
    assert [frame.kind for frame in read_run(tmp_path / "run")] == [FrameKind.HEADER], "whatever happens from now on"
    for step in range(200):
        recorder.begin({"x": np.full(50, step, np.float32)})
        recorder.end(np.zeros(2, np.float32), "")
        if step % 100 == 99:
            recorder._outlet.flush()
    recorder.close()
    *_, last = read_run(tmp_path / "run")
    assert (tmp_path / "run").stat().st_size <= 20_000
    assert last.kind is FrameKind.END
    ticks = sum(frame.kind is FrameKind.TICK for frame in read_run(tmp_path / "run"))
    assert last.values["omitted"] == 200 - ticks


def test_steps_that_a_slow_disk_has_no_time_for_are_counted_and_end_the_replay(bundle: Path, tmp_path: Path):
    stack: Any = load(bundle, threads=1, record=tmp_path / "run")
    free, append = threading.Event(), stack.recorder._file._writer.append
    stack.recorder._file._writer.append = lambda *values: (free.wait(20), append(*values))[1]
    for _ in range(600):
        stack.act({"x": np.zeros(2)})
    free.set()
    assert stack.recorder._outlet.flush(20)
    for _ in range(3):
        stack.act({"x": np.zeros(2)})
    stack.close()
    found = replay(tmp_path / "run", bundle)
    assert (found.equal, found.steps < 600) == (True, True)
    assert found.note.startswith(f"{600 - found.steps} events after it were left out")


def test_what_cannot_be_replayed_is_not_recorded(bundle: Path, tmp_path: Path):
    with pytest.raises(UsageError, match="infers in a thread of its own"):
        load(bundle, threads=1, record=tmp_path / "run", controllers=["rtc:background=true"])
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").write_text("precious")
    with pytest.raises(DataError, match="File exists"):
        load(bundle, threads=1, record=tmp_path / "run")
    assert (tmp_path / "run").read_text() == "precious"


def test_layers_look_at_the_clock_of_the_stack(bundle: Path):
    ticks = itertools.count()
    stack = build_stack(load(bundle, threads=1), clock=lambda: float(next(ticks)), fallback=Fallback())
    stack.act({"x": np.zeros(2)})
    assert stack.origin.age_ms is not None
    assert stack.origin.age_ms >= 1000, "the player's clock is that of the stack"
    assert not [layer for layer in stack.layers if isinstance(layer, Deadline)]


@contextlib.contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_no_empty_file_and_each_lost_step_is_counted(tmp_path: Path):
    with no_file_above(4), pytest.raises(DataError, match="cannot be written"):
        Recorder(tmp_path / "none")
    assert not (tmp_path / "none").exists()
    before = len(os.listdir("/proc/self/fd"))
    recorder = Recorder(tmp_path / "run")
    with no_file_above(4096):
        for _ in range(20):
            recorder.begin({"x": np.zeros(500)})
            recorder.end(None, "")
        recorder.close()
    assert recorder.failure_count == 20, "not even the first one fits"
    assert len(os.listdir("/proc/self/fd")) == before
    assert list(read_run(tmp_path / "run")) == []


def test_a_disk_that_is_full_at_the_end_leaves_no_open_file(tmp_path: Path):
    before = len(os.listdir("/proc/self/fd"))
    recorder = Recorder(tmp_path / "run")
    with no_file_above(len(MAGIC)):
        recorder.close()
    assert recorder.failure_count == 1
    assert len(os.listdir("/proc/self/fd")) == before
