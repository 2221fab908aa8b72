"""Records what a stack sees and does, so that a replay can compute it again, bit by bit."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.errors import DeadlineMissed, UsageError
from vlatool.files.messages import to_json
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.interface import Action, Array, Policy, observer_of
from vlatool.runtime.telemetry.run_file import DTYPES, Frame, FrameKind, RunHeader, RunWriter
from vlatool.runtime.telemetry.writer import Telemetry

MAX_BYTES, PENDING_BYTES, PENDING, SYNC_S = 4_000_000_000, 64_000_000, 512, 1.0
CALLS = ("start", "clear", "emergency")
"""Methods of an envelope that change what comes after them."""


class Recorder:
    """Records each control step of a stack: the observation, when its layers looked at the clock, what each policy
    answered and how late, and the action.

    A control step copies the observation; a thread writes it. Where the thread is too far behind, steps are left out,
    which the file says: a replay ends there.

    Args:
        path: A new file.
        max_bytes: Largest size of the file; later control steps are not recorded, which it says.

    Raises:
        UsageError: when a number is out of its range.
        DataError: when the file exists or cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> None:
        check_whole("max_bytes", max_bytes, 10_000)
        self._file = _RunSink(RunWriter(path), max_bytes)
        self._outlet = Telemetry(self._file, size=PENDING)
        self._put_bytes = self._put_count = 0
        self._gap = self._step = self._policies = 0
        self._thread: int | None = None
        self._readings: list[float] = []
        self._answers: list[dict[str, Any]] = []
        self._arrays: dict[str, Array] = {}

    def begin_run(self, about: RunHeader) -> None:
        """Write what the run is of, before anything else; return when it is written."""
        self._put(Frame(FrameKind.HEADER, to_json(about), {}))
        self._outlet.flush()

    def follow(self, clock: Callable[[], float]) -> Callable[[], float]:
        """Return a clock that notes what the layers read, which act in the thread of the control step."""

        def read() -> float:
            now = clock()
            if self._thread == threading.get_ident():
                self._readings.append(now)
            return now

        return read

    def wrap_policy(self, policy: Policy) -> Policy:
        """Return a policy that notes what it answers."""
        self._policies += 1
        return _NotedPolicy(policy, self, self._policies - 1)

    def wrap_envelope(self, envelope: Any) -> None:
        """Record what an envelope reads of its clock, and the calls that come from outside a control step."""
        envelope.clock = self.follow(envelope.clock)
        for name in CALLS:
            setattr(envelope, name, self._recorded(name, getattr(envelope, name)))

    def _recorded(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*values: Any, **named: Any) -> Any:
            if self._thread == threading.get_ident():  # a layer calls it within the control step
                return method(*values, **named)
            return self.call(name, lambda: method(*values, **named), [_plain(each) for each in values], named)

        return call

    def call(self, name: str, method: Callable[[], Any], values: list[Any], named: Mapping[str, Any]) -> Any:
        """Do something between two control steps, and record it."""
        self._open()
        try:
            return method()
        finally:
            self._thread = None
            self._put(Frame(FrameKind.CALL, {"name": name, "values": values, "named": dict(named),
                                             "clock": self._readings}, {}))  # fmt: skip

    def begin(self, observation: Mapping[str, Any]) -> None:
        """Begin a control step: copy its observation."""
        self._open()
        for name, value in observation.items():
            self._arrays[f"seen.{name}"] = np.array(value)

    def _open(self) -> None:
        self._readings, self._answers, self._arrays = [], [], {}
        self._thread = threading.get_ident()

    def note(self, index: int, answer: Action | None, error: BaseException | None) -> None:
        """Note what a policy answered."""
        number = len(self._answers)
        if answer is None:
            late = isinstance(error, DeadlineMissed | TimeoutError)
            self._answers.append({"policy": index, "late": late, "error": type(error).__name__,
                                  "reason": getattr(error, "message", str(error))})  # fmt: skip
            return
        self._answers.append({
            "policy": index, "latency_ms": answer.latency_ms, "age_ms": answer.age_ms,
            "latent_age_ms": answer.latent_age_ms, "sequence": answer.sequence,
            "source": answer.source, "checks": list(answer.checks), "outputs": list(answer.outputs),
        })  # fmt: skip
        self._arrays[f"chunk.{number}"] = np.array(answer.chunk)
        for name, value in answer.outputs.items():
            self._arrays[f"output.{number}.{name}"] = np.asarray(value)

    def end(self, action: Array | None, error: str) -> None:
        """End a control step: record it with its action."""
        self._thread = None
        arrays, texts = self._arrays, {}
        for name in [name for name, value in arrays.items() if value.dtype.name not in DTYPES]:
            texts[name] = _text(arrays.pop(name))
        if action is not None:
            arrays["action"] = np.array(action)
        values = {"step": self._step, "texts": texts, "clock": self._readings, "answers": self._answers, "error": error}
        self._step += 1
        self._put(Frame(FrameKind.TICK, values, arrays))

    def _put(self, frame: Frame) -> None:
        """Hand a frame to the thread, unless that is too far behind."""
        count, size = self._put_count - self._file.taken, self._put_bytes - self._file.taken_bytes
        if count >= PENDING - 1 or (count and size + frame.size > PENDING_BYTES):
            self._gap += 1
            return
        if self._gap:
            frame.values["left_out"] = self._gap
            self._gap = 0
        self._put_count, self._put_bytes = self._put_count + 1, self._put_bytes + frame.size
        self._outlet.put(frame)

    @property
    def failure_count(self) -> int:
        """Control steps that could not be written, such as on a full disk."""
        return self._outlet.failure_count + self._file.lost

    def close(self) -> None:
        """Write what is left and close the file."""
        self._outlet.close()


class _RunSink:
    """Writes frames in the thread of the telemetry."""

    def __init__(self, writer: RunWriter, max_bytes: int) -> None:
        self._writer, self._most = writer, max_bytes - 1000
        self.taken = self.taken_bytes = self.lost = self._omitted = 0
        self._full = self._failed = False
        self._synced = time.monotonic()

    def __call__(self, frame: Frame) -> None:
        self.taken, self.taken_bytes = self.taken + 1, self.taken_bytes + frame.size
        if self._failed:
            self.lost += 1
            return
        if self._full:
            self._omitted += 1
            return
        try:
            self._full = not self._writer.append(frame, self._most)
        except OSError:
            self._failed = True  # what was written of this frame ends the file for a reader
            raise
        if self._full:
            self._omitted = 1

    def flush(self) -> None:
        """Flush the disk once a second: that much is lost by a power cut."""
        if not self._failed and time.monotonic() - self._synced >= SYNC_S:
            self._synced = time.monotonic()
            self._writer.sync()

    def close(self) -> None:
        try:
            if not self._failed:
                self._writer.append(Frame(FrameKind.END, {"omitted": self._omitted}, {}))
        finally:
            self._writer.close()


class _NotedPolicy:
    """A policy whose answers are noted."""

    def __init__(self, policy: Policy, recorder: Recorder, index: int) -> None:
        self.policy, self.spec, self._recorder, self._index = policy, policy.spec, recorder, index
        self._observer = observer_of(policy)

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the policy's answer."""
        try:
            action = self.policy.infer(observation, noise=noise)
        except Exception as error:
            self._recorder.note(self._index, None, error)
            raise
        self._recorder.note(self._index, action, None)
        return action

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation of a control step at which it does not infer."""
        if self._observer is not None:
            self._observer.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; see ``Policy.reset``."""
        self.policy.reset(seed)


def refuse_background(layers: Any) -> None:
    """Refuse to record a player whose inferences, or a policy whose slow part, run beside the control steps.

    Raises:
        UsageError: naming it.
    """
    for layer in layers:
        if getattr(layer, "background", False):
            raise UsageError(
                f"{type(layer).__name__} infers in a thread of its own: what it does depends on when that is done, "
                "and cannot be replayed bit by bit.",
                "record with delay=N in the place of background=true, or without this controller",
            )
        if getattr(layer, "thread", False):
            raise UsageError(
                f"The slow part of the policy runs in a thread of its own ({type(layer).__name__}): which of its "
                "values an action uses depends on when they are there, and cannot be replayed bit by bit.",
                'record with the slow part at each k-th inference: controllers=["dual_rate:every=4"]',
            )


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else list(value) if isinstance(value, tuple) else value


def _text(value: Array) -> str:
    """Return the text of an entry; of what is neither text nor numbers its type, which no policy takes."""
    return str(value) if value.dtype.kind == "U" and not value.ndim else f"<{value.dtype}>"
