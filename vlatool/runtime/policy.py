"""The policy that a controller holds: ``infer`` and ``reset``."""

from __future__ import annotations

import contextlib
import threading
import time
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool import registry
from vlatool.bundle import Bundle
from vlatool.errors import BundleError, DataError, GraphError, UsageError
from vlatool.runtime.contract import Outputs, allowed_mb, check_chunk, check_graphs, check_sizes, not_finite
from vlatool.runtime.observation import ObservationEncoder, all_finite
from vlatool.runtime.program import Program, Session
from vlatool.runtime.statistics import Normaliser, load_normaliser
from vlatool.spec import PolicySpec, TensorSpec

DEFAULT_ENGINE = "ort_cpu"
FIRST_RUN_S = 60.0
"""How long an inference of the warm-up may take before it is stopped: far more than a policy that a robot could use."""
Array = NDArray[Any]


class Action(NamedTuple):
    """What the policy wants the robot to do.

    Args:
        chunk: (T, A) float32 in the units of the spec, or (T,) int64 indices of discrete actions.
        labels: For discrete actions, the name of each index; for others, the name of each element.
        latency_ms: From the call of ``infer`` to this object, in milliseconds.
        sequence: Number of this inference since the last reset, from 0.
        outputs: Every output of the spec by name, as the graph gave it (not un-normalised).
    """

    chunk: Array
    labels: tuple[str, ...]
    latency_ms: float
    sequence: int
    outputs: Mapping[str, Array]


class Policy:
    """An open bundle. ``infer`` maps an observation to an ``Action``; ``reset`` starts a new episode.

    It may be opened in one thread and used in another. Calls from several threads at once take turns, so that each gets
    the answer to its own observation: an error instead would hit a control loop at random, whenever calls happen to
    overlap, and a lock costs it less than a microsecond. Calls that overlap on a policy that keeps values from step to
    step are refused all the same: they would mix two episodes, which no order makes right. One policy for each thread
    also spares them the waiting.
    """

    def __init__(self, bundle: Bundle, program: Program, engine: str) -> None:
        self.bundle = bundle
        self.engine = engine
        self.spec: PolicySpec = bundle.manifest.spec
        self.program = program
        self.encode = ObservationEncoder(self.spec, bundle.path / "assets")
        self._decode = _Decoder(self.spec, bundle.path / "assets")
        self._outputs = Outputs(self.spec.outputs, action=False)
        self._sequence = 0
        self._turn = threading.RLock()  # a signal handler may strike between lock and owner
        self._owner = 0
        self.golden_error: float | None = None

    @classmethod
    def open(
        cls,
        bundle: Bundle,
        *,
        engine: str = "",
        threads: int | None = None,
        seed: int | None = None,
        memory_mb: float | None = None,
    ) -> Policy:
        """Open every graph of a verified bundle and hold it against the spec; see ``vlatool.runtime.load``."""
        manifest = bundle.manifest
        if not manifest.graphs:
            raise BundleError(f"{bundle.path} has no graph to run.", "export it first: vlatool export SOURCE -o BUNDLE")
        check_chunk(manifest.spec)
        limit_mb = allowed_mb(manifest, memory_mb)
        check_sizes(manifest, limit_mb)
        engine = engine or manifest.engine or DEFAULT_ENGINE
        session = registry.load("engines", engine)
        sessions: dict[str, Session] = {
            name: session(bundle.file(graph.file), threads, graph.compute) for name, graph in manifest.graphs.items()
        }
        check_graphs(manifest, sessions, limit_mb)
        return cls(bundle, Program(manifest.program, sessions, seed), engine)

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk.

        An inference that raises counts as if it had never been: kept values, noise and the sequence number stay.

        Args:
            observation: Input name -> value in physical units, with or without the batch axis of 1; text as ``str``.
            noise: Value name -> float32 array, in the place of what the program would draw.

        Raises:
            DataError: when the observation or the noise does not fit.
            GraphError: when the engine fails, or an output or a kept value is not finite or not as declared.
            UsageError: when another inference of a policy that keeps values is under way, or one of this thread.
        """
        start = time.perf_counter_ns()
        if self._owner:
            self._check_overlap()
        with self._turn:
            try:
                self._owner = threading.get_ident()
                outputs, chunk, labels = self.program.run(self.encode(observation), noise, self._answer)
                sequence = self._sequence
                self._sequence += 1
            finally:
                self._owner = 0
        return Action(chunk, labels, (time.perf_counter_ns() - start) / 1e6, sequence, outputs)

    def _answer(self, values: dict[str, Any]) -> tuple[dict[str, Array], Array, tuple[str, ...]]:
        outputs = self._outputs(values)
        return outputs, *self._decode(outputs[self.spec.action.name])

    def _check_overlap(self) -> None:
        """Refuse a call during an inference where taking turns would not make it right."""
        fix = "open one policy for each thread"
        if self._owner == threading.get_ident():
            raise UsageError("The policy is called while it infers, in the same thread (a signal handler?).", fix)
        if self.program.keeps:
            raise UsageError(
                "Two threads call a policy at once that keeps values from step to step; it would mix their episodes.",
                fix,
            )

    def reset(self) -> None:
        """Start a new episode: forget kept values, restart the noise from its seed.

        Raises:
            UsageError: when this thread's own inference is under way.
        """
        if self._owner == threading.get_ident():
            self._check_overlap()
        with self._turn:
            self._sequence = 0
            self.program.reset()

    @contextlib.contextmanager
    def stopped_after(self, seconds: float) -> Iterator[None]:
        """Stop the engine when the inference of this block takes longer.

        Raises:
            GraphError: when it did.
        """
        limited = [session for session in self.program.sessions.values() if hasattr(session, "deadline")]
        for session in limited:
            session.deadline = time.monotonic() + seconds
        try:
            yield
        except TimeoutError as error:
            raise GraphError(
                f"{self.bundle.path}: an inference takes longer than {seconds:g} s, so it was stopped{error}.",
                "allow a slow policy more with load(..., first_run_s=...); else its graph loops without end",
            ) from None
        finally:
            for session in limited:
                session.deadline = None

    def warm_up(self, inferences: int, tolerance: float, first_run_s: float = FIRST_RUN_S) -> None:
        """Run the golden observation, each time ``first_run_s`` at most, and compare the action with the recorded one.

        Raises:
            GraphError: when the relative L2 difference is above ``tolerance`` or not a number, or a run takes longer.
        """
        golden = load_golden(self.bundle)
        if golden is None:
            return
        observation, noise, expected = golden
        for _ in range(inferences):
            with self.stopped_after(first_run_s):
                got = self.infer(observation, noise=noise).outputs[self.spec.action.name]
            self.golden_error = relative_error(got, expected)
            self.reset()
        if inferences and not (self.golden_error or 0.0) <= tolerance:
            raise GraphError(
                f"This machine computes another golden action than recorded: relative error {self.golden_error:.3g}, "
                f"allowed {tolerance:g}.",
                "the engine or processor may lack what this precision needs; run: vlatool doctor",
            )


class _Decoder:
    """The action output -> a chunk in physical units, or indices of discrete actions."""

    def __init__(self, spec: PolicySpec, assets: Path) -> None:
        self.tensor: TensorSpec = spec.action
        self.normaliser: Normaliser | None = load_normaliser(spec.action, assets)
        self._floating = np.dtype(spec.action.dtype).kind == "f"
        self._half = spec.action.dtype == "float16"

    def __call__(self, raw: Array) -> tuple[Array, tuple[str, ...]]:
        tensor = self.tensor
        physical = raw.astype(np.float32) if self._half else raw
        if self.normaliser is not None:
            try:
                physical = self.normaliser.inverse(physical)
            except (RuntimeWarning, FloatingPointError):  # an overflow, where the caller lets numpy raise
                raise not_finite(tensor.name) from None
        if self._floating and not all_finite(physical):
            raise not_finite(tensor.name)
        if tensor.kind == "discrete":
            chunk = raw.argmax(-1).reshape(-1)
            return chunk, tuple([tensor.labels[index] for index in chunk.tolist()])
        return physical.reshape(-1, physical.shape[-1]), tensor.labels


def load_golden(bundle: Bundle) -> tuple[dict[str, Any], dict[str, Array], Array] | None:
    """Return the first golden (observation, noise, raw action output), or None when the bundle has none.

    Raises:
        DataError: when the file cannot be read.
    """
    if not bundle.manifest.golden:
        return None
    path = bundle.file(bundle.manifest.golden)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            observation = {tensor.name: stored[f"in.{tensor.name}"][0] for tensor in bundle.manifest.spec.inputs}
            noise = {key[6:]: stored[key][0] for key in stored.files if key.startswith("noise.")}
            return observation, noise, stored[f"out.{bundle.manifest.spec.action.name}"][0]
    except (ValueError, KeyError, OSError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise DataError(f"The golden file {path} cannot be read: {error}.") from error


def relative_error(got: Array, expected: Array) -> float:
    """Return ``|got - expected|₂ / |expected|₂`` (the absolute norm when expected is zero)."""
    wide = np.asarray(expected, np.float64).reshape(-1)
    distance = float(np.linalg.norm(np.asarray(got, np.float64).reshape(-1) - wide))
    return distance / (float(np.linalg.norm(wide)) or 1.0)
