"""An open bundle as a policy: ``infer`` and ``reset``."""

from __future__ import annotations

import contextlib
import functools
import math
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import GOLDEN_TOLERANCE, check_files
from vlatool.bundle.program import SlowPart, slow_part
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import BundleError, GraphError, UsageError, VlatoolError
from vlatool.files.printable import printable
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.arithmetic import int8_trouble, machine
from vlatool.runtime.contract import (
    Outputs,
    allowed_mb,
    check_chunk,
    check_graphs,
    check_sizes,
    input_shapes,
    written_as_declared,
)
from vlatool.runtime.converter import newest_moment
from vlatool.runtime.decoder import Decoder
from vlatool.runtime.engine import DEFAULT_ENGINE, FLOAT32, engine_class
from vlatool.runtime.golden import (
    GOLDEN_STEPS,
    ROBOT_CHUNK,
    Golden,
    conversion_error,
    golden_arrays,
    golden_chunks,
    golden_steps,
)
from vlatool.runtime.graph_files import open_graph
from vlatool.runtime.history import History
from vlatool.runtime.identity import policy_identity
from vlatool.runtime.interface import Action, Array
from vlatool.runtime.observation import EncodedObservation, ObservationEncoder, all_finite
from vlatool.runtime.program import Program, Session

if TYPE_CHECKING:
    from vlatool.runtime.engine_record import EngineRecord

FLOAT_ROUNDING = 1e-3
"""Relative difference of a float32 golden action that a different order of summation explains; observed: up to 6e-7."""
CONVERSION_TOLERANCE = 1e-4
"""Largest relative difference of a converted golden action: numpy converts the same numbers on each machine."""
FIRST_RUN_S = 60.0
"""Time limit of one inference in the warm-up: far more than any policy that a robot could use would take."""


class BundlePolicy:
    """An open bundle. ``infer`` maps an observation to an ``Action``; ``reset`` starts a new episode.

    It may be opened in one thread and used in another. Simultaneous calls from several threads take turns, so that each
    gets the answer to its own observation: an error instead would hit a control loop at random, whenever calls happen
    to overlap, while a lock costs less than a microsecond. For a policy that keeps values from step to step,
    overlapping calls are refused, because they would mix two episodes in any order. With one policy for each thread,
    no thread has to wait.

    Args:
        inputs: Inputs that its program takes; those of the spec when None.
    """

    def __init__(self, bundle: Bundle, program: Program, engine: str, *, inputs: Collection[str] | None = None) -> None:
        self.bundle = bundle
        self.engine = engine
        self.spec: PolicySpec = bundle.manifest.spec
        self.program = program
        self._history = History(self.spec, inputs)
        self.encode = ObservationEncoder(self.spec, bundle, self._history, inputs)
        self._decode = Decoder(self.spec, bundle)
        certain = written_as_declared(bundle.manifest, program.sessions)
        self._outputs = Outputs(self.spec.outputs, action=False, certain=certain)
        self._action = self.spec.action.name
        self._direct = program.plain and self._outputs.certain
        self._sequence = 0
        self._turn = threading.RLock()  # a signal handler may call while this thread holds it
        self._busy = False
        self.engine_reason = ""
        """Why the engine was chosen, as a sentence; empty where it was named, or is the bundle's."""
        self.limit_s: float | None = None
        """Time limit of an inference in seconds, after which it is stopped; no limit when None."""
        self.spent_ns: tuple[int, int, int, int] | None = None
        """Nanoseconds of the last inference: encoding, graphs, decoding, and 0 for the way to another thread."""
        self.golden_error: float | None = None
        self.golden_chunk_error: float | None = None
        self.golden_conversion_error: float | None = None

    @classmethod
    def open(
        cls,
        bundle: Bundle,
        *,
        engine: str = "",
        threads: int | None = None,
        seed: int | None = None,
        memory_mb: float | None = None,
        traced: bool = False,
    ) -> BundlePolicy:
        """Open every graph of a verified bundle and check it against the spec; see ``vlatool.runtime.load``.

        Args:
            traced: Whether ``engine_record`` is to tell what ran.
        """
        manifest = bundle.manifest
        if not manifest.graphs:
            from vlatool.bundle.module_bundle import no_graph_error

            raise no_graph_error(bundle, "run")
        check_chunk(manifest.spec)
        limit_mb = allowed_mb(manifest, memory_mb)
        check_sizes(manifest, limit_mb)
        engine = engine or manifest.engine or DEFAULT_ENGINE
        session = engine_class(engine)
        check_files(manifest)
        sessions: dict[str, Session] = {
            name: open_graph(bundle, graph, session, threads, traced, input_shapes(manifest, name))
            for name, graph in manifest.graphs.items()
        }
        check_graphs(manifest, sessions, limit_mb)
        outputs = [tensor.name for tensor in manifest.spec.outputs]
        return cls(bundle, Program(manifest.program, sessions, seed, outputs), engine)

    @functools.cached_property
    def identity(self) -> str:
        """``sha256:...`` over all that decides how a robot behaves with this policy: for telemetry and logs."""
        return policy_identity(self.bundle)

    @property
    def slow(self) -> SlowPart | None:
        """How the slow part of a policy of two systems runs beside the fast one; None for a policy without one.

        ``infer`` runs both, one after the other; ``control.dual_rate`` runs the slow part beside the fast one.
        """
        return slow_part(self.bundle.manifest.program)

    def engine_record(self) -> EngineRecord:
        """Return what the engine ran of each graph, on what and in which precision, against what the bundle promises.

        The policy must be opened for it (``load(..., engine_proof="record")``) and have inferred once: ONNX Runtime
        notes the nodes of the first run of each graph, and no others.
        Where nothing has been noted, that is one of its problems.
        """
        from vlatool.runtime.engine_record import engine_record

        return engine_record(self.engine, self.bundle.manifest.graphs, self.program.sessions)

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk.

        An inference that raises has no effect: kept values, noise and the sequence number stay as they were.

        Args:
            observation: Input name -> value in physical units, with or without the batch axis of 1; text as ``str``.
                An input with a ``history`` is given as this moment, to which the last ones since ``reset`` are added
                (``observe``), or with all its moments, which are then its history. An ``EncodedObservation``, as
                ``encode`` returns it, is used unchanged.
            noise: Value name -> float32 array that replaces the noise that the program would draw.

        Raises:
            DataError: when the observation or the noise does not fit.
            GraphError: when the engine fails or takes longer than ``limit_s``, or an output or a kept value is not
                finite or not as declared.
            UsageError: when another inference is in progress, of a policy that keeps values or in the same thread.
            TimeoutError: when ``stop`` is called.
        """
        start = time.perf_counter_ns()
        if not self._history.lengths:
            return self._infer(observation, noise, start)
        if self._busy:
            self._check_overlap()
        with self._history.with_moment(self.encode, observation) as encoded:
            return self._infer(encoded, noise, start)

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep the observation of a control step without an inference, for inputs with a ``history``.

        Where there is none, this does nothing. It does not wait for an inference in another thread.

        Args:
            observation: As ``infer`` takes it.

        Raises:
            DataError: when the observation does not fit; it is then not kept.
        """
        if self._history.lengths:
            with self._history.with_moment(self.encode, observation):
                pass

    def _infer(self, observation: Mapping[str, Any], noise: Mapping[str, Array] | None, start: int) -> Action:
        if self._busy:
            self._check_overlap()
        limit = contextlib.nullcontext() if self.limit_s is None else self._stopped_after(self.limit_s)
        with self._turn, limit:
            try:
                self._busy = True
                encoded = self.encode(observation)
                ready = self._inferred = time.perf_counter_ns()
                if self._direct:
                    values = self.program.run(encoded, noise)
                    self._inferred = time.perf_counter_ns()
                    outputs = {name: values[name] for name in self._outputs.names}
                    chunk, labels = self._decode(outputs[self._action], encoded.state)
                else:
                    answer = functools.partial(self._answer, encoded.state)
                    outputs, (chunk, labels) = self.program.run(encoded, noise, answer)
                sequence = self._sequence
                self._sequence += 1
            finally:
                self._busy = False
        end, inferred = time.perf_counter_ns(), self._inferred
        self.spent_ns = ready - start, inferred - ready, end - inferred, 0
        taken_ms = (end - start) / 1e6
        return Action(chunk, labels, taken_ms, sequence, outputs, age_ms=taken_ms)

    def _answer(
        self, state: Array | None, values: dict[str, Any]
    ) -> tuple[dict[str, Array], tuple[Array, tuple[str, ...]]]:
        self._inferred = time.perf_counter_ns()
        outputs = self._outputs(values)
        return outputs, self._decode(outputs[self._action], state)

    def stop(self) -> None:
        """End the inference in progress, from another thread; it and later ones raise TimeoutError until ``resume``.

        An engine stops between two nodes of a graph. It does so from the first call of ``resume`` on.
        """
        self.program.stop()

    def resume(self) -> None:
        """Allow inferences again after ``stop``."""
        self.program.resume()

    @property
    def snapshot(self) -> tuple[Any, ...]:
        """What ``restore`` takes: the sequence number, kept values, noise and earlier moments."""
        return self._sequence, self.program.snapshot, self._history.snapshot

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Take back the last inference: all is as it was when the snapshot was taken. Moments observed since stay."""
        with self._turn:
            self._sequence, program, history = snapshot
            self.program.restore(program)
            self._history.restore(history)

    def decode(self, raw: Array, encoded: EncodedObservation | None = None) -> Array:
        """Return the chunk of the graph's raw action: (T, A) in the units of the spec, or (T,) indices.

        Args:
            encoded: the observation that it answers, for an action that is relative to a state.
        """
        return self._decode(raw, None if encoded is None else encoded.state)[0]

    def golden_chunk(self, action: Action) -> Array:
        """Return what of an action is compared between machines in physical units: (T, A), or (T,) indices.

        That is the chunk, of an action that is converted the chunk before it is.
        """
        if not self.spec.action.convert:
            return action.chunk
        return self._decode.unnormalise(action.outputs[self._action])

    def _check_overlap(self) -> None:
        """Refuse a call during an inference if waiting for it would not help."""
        fix = "open one policy for each thread"
        if self._turn.acquire(blocking=False):  # this thread holds the lock already, or it has just been released
            self._turn.release()
            if self._busy:
                raise UsageError(
                    "The policy is called again during an inference, in the same thread (a signal handler?).", fix
                )
        elif self.program.keeps or self._history.lengths:
            raise UsageError(
                "Two threads call a policy that keeps values between steps at once; that would mix their episodes.",
                fix,
            )

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode: forget kept values and earlier moments, restart the noise.

        Args:
            seed: Seed of this episode's noise; the policy's own when None, so that all episodes draw the same noise.

        Raises:
            UsageError: when the seed is not a whole number from 0, or an inference of this thread is in progress.
        """
        check_whole("seed", seed, 0, optional=True)
        with self._turn:
            if self._busy:
                self._check_overlap()
            self._sequence = 0
            self._history.forget()
            self.program.reset(seed)

    @contextlib.contextmanager
    def _stopped_after(self, seconds: float) -> Iterator[None]:
        """Stop the engine if the inference in this block takes longer; raises GraphError when it was stopped."""
        limited = [session for session in self.program.sessions.values() if hasattr(session, "deadline")]
        for session in limited:
            session.deadline = time.monotonic() + seconds
        try:
            yield
        except TimeoutError as error:
            raise GraphError(
                f"{self.bundle.path}: an inference takes longer than {seconds:g} s, so it was stopped{error}.",
                "look for a loop without end in its graph; a robot allows more: load(..., first_run_s=...)",
            ) from None
        finally:
            for session in limited:
                session.deadline = None

    def warm_up(self, inferences: int, tolerance: float | None = None, first_run_s: float = FIRST_RUN_S) -> None:
        """Run the golden observations one after the other, as they were recorded, and compare the actions.

        Args:
            inferences: Minimum number of inferences, at least one for each golden observation; 0 for none at all.
            tolerance: Largest relative L2 difference of outputs and of chunks; those in the manifest when None.
            first_run_s: Time limit of each inference in seconds.

        Raises:
            BundleError: when a program that keeps values has only one golden step, or the bundle converts its golden
                action to another one than recorded.
            DataError: when the golden file cannot be read.
            GraphError: when the difference is larger or not a number, or an inference takes longer.
        """
        caches = [cache for session in self.program.sessions.values() if (cache := getattr(session, "cache", None))]
        try:
            self.replay_golden(inferences, first_run_s)
            self.check_golden(tolerance)
        except VlatoolError:
            for cache in caches:
                cache.discard()
            raise
        for cache in caches if self.golden_error is not None else ():
            cache.keep()

    def replay_golden(self, inferences: int, first_run_s: float = FIRST_RUN_S) -> None:
        """Run the golden observations as ``warm_up`` does, and store how far the actions are from the recorded ones.

        Raises:
            BundleError, DataError, GraphError: as ``warm_up`` does, but not for a difference.
        """
        stored = golden_arrays(self.bundle)
        steps = golden_steps(self.bundle, stored)
        if self.program.keeps and steps and len(steps) < GOLDEN_STEPS:
            raise BundleError(
                f"The golden file of {self.bundle.path} has one step; a policy that keeps values needs {GOLDEN_STEPS}.",
                "export the policy again",
            )
        if not steps or not inferences:
            return
        errors: list[float] = []
        of_chunks: list[float] = []
        chunks = golden_chunks(self.spec.action, stored, len(steps))
        limit, self.limit_s = self.limit_s, first_run_s
        try:
            for number in range(max(inferences, len(steps))):
                observation, noise, expected = steps[number % len(steps)]
                if not number % len(steps):
                    self.reset()
                action = self.infer(observation, noise=noise)
                errors.append(relative_error(action.outputs[self.spec.action.name], expected))
                if chunks:
                    of_chunks.append(self.golden_difference(action, chunks[number % len(steps)]))
        finally:
            self.limit_s = limit
        self.reset()
        self.golden_error, self.golden_chunk_error = _worst(errors), _worst(of_chunks)
        converted = golden_chunks(self.spec.action, stored, len(steps), ROBOT_CHUNK)
        self.golden_conversion_error = _worst(
            conversion_error(self._converted(step), expected)
            for step, expected in zip(steps, converted, strict=False)
            if all_finite(step[2])
        )

    def _converted(self, golden: Golden) -> Array:
        """Return what the conversion makes of a recorded raw action; the engine has no part in it."""
        observation, _, raw = golden
        reference = self.spec.reference
        state = None if reference is None else newest_moment(observation[reference.name], reference.robot_width)
        return self._decode(raw, state)[0]

    def check_golden(self, tolerance: float | None = None) -> None:
        """Check the differences that the warm-up stored against the tolerances.

        Args:
            tolerance: Largest relative L2 difference of outputs and of chunks; those in the manifest when None.

        Raises:
            BundleError: when the conversion makes another action of the golden one than recorded.
            GraphError: when a difference is larger or not a number.
        """
        limits = self.golden_tolerances if tolerance is None else (tolerance, tolerance)
        measured = zip((self.golden_error, self.golden_chunk_error), limits, ("", " in physical units"), strict=True)
        for error, allowed, where in measured:
            if error is not None and not error <= allowed:
                cause, remedy = int8_trouble(self.bundle.manifest, self.engine)
                raise GraphError(
                    f"This {machine(self.engine)} computes a different golden action{where} than recorded: "
                    f"relative error {error:.3g}, allowed {allowed:g}.{cause and ' ' + cause}",
                    remedy
                    or self._made_for()
                    or "the engine or processor may lack what this precision needs; run: vlatool doctor",
                )
        allowed = max(CONVERSION_TOLERANCE, tolerance or 0.0)
        if (error := self.golden_conversion_error) is not None and not error <= allowed:
            raise BundleError(
                f"The conversion of '{self.spec.action.name}' in {self.bundle.path} makes another action of the golden "
                f"one than recorded: relative error {error:.3g}, allowed {allowed:g}. Its spec ('convert', 'parts', "
                "statistics) was changed after the bundle was made.",
                "make the bundle again from the policy, with what is right in its policy.yaml",
            )

    def _made_for(self) -> str:
        """Return a fix that names the bundle's engine, if a different one runs it."""
        engine = self.bundle.manifest.engine or DEFAULT_ENGINE
        if engine == self.engine:
            return ""
        return f"the bundle was made for {engine}: load it with engine={engine!r}, or make one for {self.engine}"

    def golden_difference(self, action: Action, expected: Array) -> float:
        """Return the relative L2 difference of an action's ``golden_chunk`` from another."""
        return self._spread_error(self.golden_chunk(action), expected)

    def chunk_error(self, got: Array, expected: Array) -> float:
        """Return the relative L2 difference of two chunks in physical units; infinite when their sizes differ.

        Each element is taken from the offset of its statistics, in units of their spread. Otherwise rounding would look
        like another action where a gripper near zero is the difference of two large numbers, and small elements would
        not show beside large ones.

        Args:
            got: Chunk (T, A) in the units of the spec.
            expected: Recorded chunk of the same shape and units.
        """
        return relative_error(got, expected) if self.spec.action.convert else self._spread_error(got, expected)

    def _spread_error(self, got: Array, expected: Array) -> float:
        normaliser = self._decode.normaliser
        if normaliser is None or got.shape != expected.shape:
            return relative_error(got, expected)
        with np.errstate(over="ignore", invalid="ignore"):
            spread = [
                (np.asarray(chunk, np.float64) - normaliser.offset) / normaliser.scale for chunk in (got, expected)
            ]
            return relative_error(*spread)

    @property
    def golden_tolerances(self) -> tuple[float, float]:
        """Largest relative L2 differences that the manifest allows: of outputs, and of chunks in physical units."""
        manifest = self.bundle.manifest
        own = manifest.golden_tolerance or GOLDEN_TOLERANCE
        return own, manifest.golden_chunk_tolerance or own

    @property
    def golden_explained(self) -> float:
        """Largest difference of a golden action that rounding explains.

        A quantized policy may differ as much as the manifest allows: its tolerance is the difference that was measured
        between engine and graphs when the bundle was made.
        """
        floats = all(set(graph.precision) <= {FLOAT32} and graph.compute in ("", FLOAT32)
                     for graph in self.bundle.manifest.graphs.values())  # fmt: skip
        return min(FLOAT_ROUNDING, self.golden_tolerances[0]) if floats else self.golden_tolerances[0]


Policy = BundlePolicy
"""Former name of the class, from before the protocol ``vlatool.runtime.interface.Policy`` existed."""


def refuse_findings(bundle: Bundle, accept: Iterable[str] = ()) -> None:
    """Refuse a bundle in which a stage found something wrong.

    Args:
        accept: Names of accepted findings.

    Raises:
        GraphError: naming the first finding that is not accepted.
    """
    allowed = set(accept)
    for finding in bundle.manifest.findings:
        if finding["name"] not in allowed:
            name, message = printable(finding["name"]), printable(finding["message"])
            raise GraphError(
                f"{bundle.path} was found to be wrong when it was made ({name}): {message}",
                f"make it differently; to use it anyway, accept the finding by name: {name}",
            )


def _worst(errors: Iterable[float]) -> float | None:
    """Return the largest error (NaN counts as the largest), or None if there is none."""
    known = list(errors)
    return next(filter(math.isnan, known), max(known, default=None))


def relative_error(got: Array, expected: Array) -> float:
    """Return ``|got - expected|₂ / |expected|₂`` (``|got|₂`` if expected is zero); infinite when sizes differ."""
    wide = np.asarray(expected, np.float64).reshape(-1)
    flat = np.asarray(got, np.float64).reshape(-1)
    if flat.shape != wide.shape:
        return math.inf
    return float(np.linalg.norm(flat - wide)) / (float(np.linalg.norm(wide)) or 1.0)
