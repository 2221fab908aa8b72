"""Computes a recorded run again and compares it, bit by bit."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, NoReturn

import numpy as np

from vlatool.errors import DataError, DeadlineMissed, GraphError
from vlatool.files.messages import from_json
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.interface import Action, Array, Policy, layers_of, observer_of
from vlatool.runtime.telemetry.recorder import CALLS
from vlatool.runtime.telemetry.run_file import Frame, FrameKind, RunHeader, read_run


@dataclass(frozen=True)
class Difference:
    """Where a replay first differs from the recording.

    Args:
        step: Number of the control step.
        output: ``action``, an output of the policy, ``chunk``, or what else.
        element: Index of the first element that differs, without the batch axis; empty where it is not one element.
        recorded: What was recorded.
        replayed: What the replay gives.
    """

    step: int
    output: str
    element: tuple[int, ...]
    recorded: str
    replayed: str


@dataclass(frozen=True)
class ReplayResult:
    """What a replay found.

    Args:
        steps: Control steps that were compared.
        equal: Whether all of them are bit-equal.
        difference: The first difference; None without one.
        note: Why the recording ends where it does, where it does not end with the run; else empty.
    """

    steps: int
    equal: bool
    difference: Difference | None
    note: str

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return asdict(self)


class _Diverged(BaseException):  # no layer may answer it with a fallback
    def __init__(self, output: str, recorded: str, replayed: str, element: tuple[int, ...] = ()) -> None:
        self.output, self.recorded, self.replayed, self.element = output, recorded, replayed, element


class Replay:
    """Stands in for the recorder of a stack that is built again: gives its layers what was recorded.

    Args:
        path: The file.

    Raises:
        DataError: as ``read_run`` does, when the file is read, and when it holds no run.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = str(path)
        self._frames: Iterator[Frame] = read_run(path)
        header = next(self._frames, None)
        if header is None:
            raise DataError(f"{path} ends before the run begins.", "record again")
        try:
            self.about = from_json(RunHeader, header.values)
            """What the run is of."""
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}: its header is wrong ({error}).", "record again with this version") from None
        self._readings: list[float] = []
        self._answers: list[tuple[int, dict[str, Any]]] = []
        self._frame = header
        self._last = 0.0
        self._count = 0

    def follow(self, clock: Callable[[], float]) -> Callable[[], float]:
        """Return a clock that gives what was read."""
        return self._read

    def _read(self) -> float:
        if self._readings:
            self._last = self._readings.pop(0)
        elif self._frame.kind is not FrameKind.HEADER:
            raise _Diverged("clock", "not read", "read")
        return self._last

    def wrap_policy(self, policy: Policy) -> Policy:
        """Return a policy that computes what was computed, and answers as late as it did."""
        self._count += 1
        return _ReplayedPolicy(policy, self, self._count - 1)

    def wrap_envelope(self, envelope: Any) -> None:
        """Let it read what was read."""
        envelope.clock = self._read

    def begin(self, observation: Mapping[str, Any]) -> None:
        """It was begun."""

    def end(self, action: Array | None, error: str) -> None:
        """``run`` compares the action."""

    def close(self) -> None:
        """Nothing is open."""

    def answer(self, index: int) -> tuple[int, dict[str, Any]]:
        """Return the number and the values of the next recorded answer, which has to be of this policy."""
        if not self._answers or self._answers[0][1]["policy"] != index:
            raise _Diverged("inference", "none", f"one of policy {index}")
        return self._answers.pop(0)

    def compare(self, output: str, name: str, value: Any) -> None:
        """Compare an array with that of the recording; raises ``_Diverged``."""
        recorded, replayed = self._frame.arrays.get(name), np.asarray(value)
        if recorded is None:
            raise _Diverged(output, "none", _form(replayed))
        if (recorded.dtype, recorded.shape) != (replayed.dtype, replayed.shape):
            raise _Diverged(output, _form(recorded), _form(replayed))
        if recorded.tobytes() == replayed.tobytes():
            return
        wide = (*recorded.shape, recorded.dtype.itemsize)
        one, other = (np.frombuffer(each.tobytes(), np.uint8).reshape(wide) for each in (recorded, replayed))
        element = tuple(int(axis) for axis in np.argwhere((one != other).any(-1))[0])
        raise _Diverged(output, repr(recorded[element].item()), repr(replayed[element].item()), element)

    def recorded_action(self, number: int, values: Mapping[str, Any], labels: tuple[str, ...]) -> Action:
        """Return what a policy answered that cannot be asked again."""
        arrays = self._frame.arrays
        outputs = {name: arrays[f"output.{number}.{name}"] for name in values["outputs"]}
        return _as_late(Action(arrays[f"chunk.{number}"].copy(), labels, 0.0, values["sequence"], outputs), values)

    def run(self, stack: Any) -> ReplayResult:
        """Play all frames on a stack that was built with this replay.

        Raises:
            DataError: at a frame that is damaged, or that does not hold what it should.
        """
        steps = 0
        for frame in self._frames:
            self._frame = frame
            if (note := _end_of(frame)) is not None:
                return ReplayResult(steps, True, None, note)
            try:
                self._play(stack)
            except _Diverged as found:
                difference = Difference(steps, found.output, found.element, found.recorded, found.replayed)
                return ReplayResult(steps, False, difference, "")
            except (KeyError, TypeError, AttributeError, IndexError) as error:
                raise DataError(f"{self.path}: the frame of step {steps} lacks something ({error}).",
                                "record again with this version") from error  # fmt: skip
            steps += frame.kind is FrameKind.TICK
        return ReplayResult(steps, True, None, "the recording was cut off: its process did not close it")

    def _play(self, stack: Any) -> None:
        values = self._frame.values
        self._readings = list(values["clock"])
        if self._frame.kind is FrameKind.CALL:
            self._call(stack, values)
            return
        self._answers = list(enumerate(values["answers"]))
        seen = {name[5:]: array.copy() for name, array in self._frame.arrays.items() if name.startswith("seen.")}
        seen |= {name[5:]: text for name, text in values["texts"].items()}
        action, error = None, ""
        try:
            action = stack.act(seen)
        except Exception as raised:  # the seam: what a layer raised then, it raises again
            error = f"{type(raised).__name__}: {raised}"
        if (recorded := values["error"]).partition(":")[0] != error.partition(":")[0]:  # texts may name paths
            raise _Diverged("error", recorded or "none", error or "none")
        if action is not None:
            self.compare("action", "action", action)
        if self._answers or self._readings:
            raise _Diverged("inference" if self._answers else "clock", "read", "not read")

    def _call(self, stack: Any, values: Mapping[str, Any]) -> None:
        if values["name"] == "reset":
            target: Any = stack
        elif values["name"] in CALLS:
            target = next(layer.envelope for layer in stack.layers if hasattr(layer, "envelope"))
        else:
            raise KeyError(values["name"])
        with contextlib.suppress(Exception):  # it raised then, too
            getattr(target, values["name"])(*values["values"], **values["named"])


class _ReplayedPolicy:
    """A policy without its deadline: whether it was late is in the recording."""

    def __init__(self, policy: Policy, replay: Replay, index: int) -> None:
        self.policy = _without_deadline(policy)
        self.spec, self._replay, self._index = policy.spec, replay, index
        self._known = not isinstance(self.policy, RecordedAnswers)
        self._observer = observer_of(policy)

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the recorded answer, computed again."""
        number, values = self._replay.answer(self._index)
        if values.get("late"):
            raise DeadlineMissed(values["reason"])
        if "error" in values:
            return self._failed(observation, noise, values)
        if not self._known:
            return self._replay.recorded_action(number, values, self.spec.action.labels)
        action: Action = self.policy.infer(observation, noise=noise)
        for name in action.outputs:
            self._replay.compare(name, f"output.{number}.{name}", action.outputs[name])
        self._replay.compare("chunk", f"chunk.{number}", action.chunk)
        return _as_late(action, values)

    def _failed(self, observation: Any, noise: Any, values: Mapping[str, Any]) -> NoReturn:
        """Fail as it did."""
        if not self._known:
            raise GraphError(values["reason"], "replay the run with the bundle that ran, or the second one")
        try:
            self.policy.infer(observation, noise=noise)
        except Exception as error:
            if type(error).__name__ == values["error"]:
                raise
            raise _Diverged("error", values["error"], type(error).__name__) from error
        raise _Diverged("error", values["error"], "none")

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation of a control step at which it does not infer."""
        if self._observer is not None:
            self._observer.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; see ``Policy.reset``."""
        self.policy.reset(seed)


def _without_deadline(policy: Any) -> Any:
    """Return a policy without the deadlines around it and inside it."""
    while isinstance(policy, Deadline):
        policy = policy.policy
    for layer in layers_of(policy):
        while isinstance(getattr(layer, "policy", None), Deadline):
            layer.policy = layer.policy.policy
    return policy


class RecordedAnswers:
    """Stands for a policy that cannot be asked again, such as one of another machine: its recorded answers are used."""

    def __init__(self, spec: Any) -> None:
        self.spec = spec

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Never called: the replay answers."""
        raise NotImplementedError

    def reset(self, seed: int | None = None) -> None:
        """Nothing is carried from episode to episode."""


def _end_of(frame: Frame) -> str | None:
    """Return why the recording ends before a frame, empty where the run does; None where it goes on."""
    if left_out := frame.values.get("left_out"):
        return f"{left_out} events after it were left out: the disk was too slow"
    if frame.kind is not FrameKind.END:
        return None
    omitted = frame.values.get("omitted")
    return f"{omitted} events after it did not fit into the file" if omitted else ""


def _form(array: Array) -> str:
    return f"{array.dtype} {list(array.shape)}"


def _as_late(action: Action, values: Mapping[str, Any]) -> Action:
    """Return an action with the times that were recorded."""
    return action._replace(latency_ms=values["latency_ms"], age_ms=values["age_ms"],
                           latent_age_ms=values.get("latent_age_ms"))  # fmt: skip
