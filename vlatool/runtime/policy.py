"""The policy that a controller holds: ``infer`` and ``reset``."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool import registry
from vlatool.bundle import Bundle
from vlatool.errors import BundleError, DataError, GraphError, nearest
from vlatool.limits import check
from vlatool.manifest import ProgramStep, check_files
from vlatool.npz_files import open_npz
from vlatool.runtime.assets import Assets
from vlatool.runtime.graph_files import open_graph
from vlatool.runtime.observation import ObservationEncoder, all_finite
from vlatool.runtime.program import Program, Session
from vlatool.runtime.statistics import Normaliser, load_normaliser
from vlatool.spec import PolicySpec, TensorSpec

DEFAULT_ENGINE = "ort_cpu"
GOLDEN_STEPS = 2
"""Golden observations in a row that a program with kept values needs: the first alone does not show what was kept."""
Array = NDArray[Any]
Golden = tuple[dict[str, Any], dict[str, Array], Array]


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

    Not safe for calls from several threads at once: open one policy for each thread.
    """

    def __init__(self, bundle: Bundle, program: Program, engine: str) -> None:
        self.bundle = bundle
        self.engine = engine
        self.spec: PolicySpec = bundle.manifest.spec
        self.program = program
        self.encode = ObservationEncoder(self.spec, bundle)
        self._decode = _Decoder(self.spec, bundle)
        self._outputs = [tensor.name for tensor in self.spec.outputs]
        self._sequence = 0
        self.golden_error: float | None = None

    @classmethod
    def open(cls, bundle: Bundle, *, engine: str = "", threads: int | None = None, seed: int | None = None) -> Policy:
        """Open every graph of a verified bundle; see ``vlatool.runtime.load``."""
        manifest = bundle.manifest
        if not manifest.graphs:
            raise BundleError(f"{bundle.path} has no graph to run.", "export it first: vlatool export SOURCE -o BUNDLE")
        engine = engine or manifest.engine or DEFAULT_ENGINE
        session = registry.load("engines", engine)
        check_files(manifest)
        sessions: dict[str, Session] = {
            name: open_graph(bundle, graph, session, threads) for name, graph in manifest.graphs.items()
        }
        _check_names(manifest.program, sessions)
        return cls(bundle, Program(manifest.program, sessions, seed), engine)

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk.

        Args:
            observation: Input name -> value in physical units, with or without the batch axis of 1; text as ``str``.
            noise: Value name -> float32 array, in the place of what the program would draw.

        Raises:
            DataError: when the observation does not fit the spec.
            GraphError: when the engine fails or the action is not finite.
        """
        start = time.perf_counter_ns()
        values = self.program.run(self.encode(observation), noise)
        outputs = {name: values[name] for name in self._outputs}
        chunk, labels = self._decode(outputs[self._outputs[0]])
        sequence = self._sequence
        self._sequence += 1
        return Action(chunk, labels, (time.perf_counter_ns() - start) / 1e6, sequence, outputs)

    def reset(self) -> None:
        """Start a new episode: forget kept values, restart the noise from its seed."""
        self._sequence = 0
        self.program.reset()

    def warm_up(self, inferences: int, tolerance: float) -> None:
        """Run the golden observations one after the other, as they were recorded, and compare the actions.

        Args:
            inferences: At least so many, and each golden observation once; none when 0.
            tolerance: Largest relative L2 difference.

        Raises:
            BundleError: when a program that keeps values has but one golden step.
            DataError: when the golden file cannot be read.
            GraphError: when the relative L2 difference is above ``tolerance`` or not a number.
        """
        steps = load_goldens(self.bundle)
        keeps = any(step.keep for step in self.program.steps)
        if keeps and steps and len(steps) < GOLDEN_STEPS:
            raise BundleError(
                f"The golden file of {self.bundle.path} has one step; a policy that keeps values needs {GOLDEN_STEPS}.",
                "export the policy again",
            )
        if not steps or not inferences:
            return
        errors: list[float] = []
        chunks = _golden_chunks(self.bundle, len(steps))
        for number in range(max(inferences, len(steps))):
            observation, noise, expected = steps[number % len(steps)]
            if not number % len(steps):
                self.reset()
            action = self.infer(observation, noise=noise)
            errors.append(relative_error(action.outputs[self.spec.action.name], expected))
            if chunks:
                errors.append(relative_error(action.chunk, chunks[number % len(steps)]))
        self.reset()
        self.golden_error = next(filter(math.isnan, errors), max(errors))
        if not self.golden_error <= tolerance:
            raise GraphError(
                f"This machine computes another golden action than recorded: relative error {self.golden_error:.3g}, "
                f"allowed {tolerance:g}.",
                "the engine or processor may lack what this precision needs; run: vlatool doctor",
            )


def _check_names(program: tuple[ProgramStep, ...], sessions: Mapping[str, Any]) -> None:
    """Refuse a program that feeds an input, or takes an output, which its graph does not have."""
    for number, step in enumerate(program):
        session = sessions[step.graph]
        for names, known, what in ((step.feeds, session.inputs, "input"), (step.gives, session.outputs, "output")):
            for name in names:
                if name not in known:
                    told = f"the {what} '{name}', which the graph '{step.graph}' does not have; {nearest(name, known)}"
                    raise GraphError(f"Step {number} of the program names {told}.")


class _Decoder:
    """The action output -> a chunk in physical units, or indices of discrete actions."""

    def __init__(self, spec: PolicySpec, assets: Assets) -> None:
        self.tensor: TensorSpec = spec.action
        self.normaliser: Normaliser | None = load_normaliser(spec.action, assets)
        self._floating = np.dtype(spec.action.dtype).kind == "f"

    def __call__(self, raw: Array) -> tuple[Array, tuple[str, ...]]:
        tensor = self.tensor
        if self._floating and not all_finite(raw):
            raise GraphError(
                f"The output '{tensor.name}' is not finite.", "do not execute it; check the last observation"
            )
        if tensor.kind == "discrete":
            chunk = raw.argmax(-1).reshape(-1)
            return chunk, tuple([tensor.labels[index] for index in chunk.tolist()])
        physical = raw if self.normaliser is None else self.normaliser.inverse(raw)
        return physical.reshape(-1, physical.shape[-1]), tensor.labels


def load_golden(bundle: Bundle) -> Golden | None:
    """Return the first golden (observation, noise, raw action output), or None when the bundle has none.

    Raises:
        BundleError: when the file is not the one that the manifest records.
        DataError: when the file cannot be read or does not fit the spec.
    """
    return next(iter(load_goldens(bundle)), None)


def load_goldens(bundle: Bundle) -> list[Golden]:
    """Return every golden (observation, noise, raw action output), in the order in which they follow a reset.

    Raises:
        BundleError: when the file is not the one that the manifest records.
        DataError: when the file cannot be read or does not fit the spec.
    """
    name, spec = bundle.manifest.golden, bundle.manifest.spec
    if not name:
        return []
    where = f"The golden file {bundle.path / name}"
    stored = open_npz(bundle.read(name, "golden_bytes"), "golden_bytes", where=where)
    noise = [key for key in stored if key.startswith("noise.")]
    action = f"out.{spec.action.name}"
    needed = [*(f"in.{tensor.name}" for tensor in spec.inputs), *noise, action]
    for key in needed:
        if key not in stored:
            raise DataError(f"{where} cannot be read: it has no '{key}'; {nearest(key, stored)}.")
        numbers = stored[key].dtype.kind in "fiu" or (key not in noise and key != action)
        if not stored[key].ndim or not len(stored[key]) or not numbers:
            raise DataError(f"{where} cannot be read: '{key}' has no steps, or no numbers.")
    counts = {len(stored[key]) for key in needed}
    if len(counts) > 1:
        raise DataError(f"{where} cannot be read: its arrays have {sorted(counts)} steps.")
    check("golden_steps", max(counts), where, DataError)
    return [
        (
            {tensor.name: stored[f"in.{tensor.name}"][step] for tensor in spec.inputs},
            {key.removeprefix("noise."): stored[key][step] for key in noise},
            stored[action][step],
        )
        for step in range(counts.pop())
    ]


def _golden_chunks(bundle: Bundle, steps: int) -> list[Array]:
    """Return the recorded actions in physical units; none for indices, and where they were not recorded."""
    name, action = bundle.manifest.golden, bundle.manifest.spec.action
    stored = open_npz(bundle.read(name, "golden_bytes"), "golden_bytes", where=name).get(f"chunk.{action.name}")
    if stored is None or action.kind == "discrete" or not stored.ndim or stored.dtype.kind not in "fiu":
        return []
    return list(stored) if len(stored) == steps else []


def relative_error(got: Array, expected: Array) -> float:
    """Return ``|got - expected|₂ / |expected|₂`` (the absolute norm when that is zero); infinite for other sizes."""
    wide = np.asarray(expected, np.float64).reshape(-1)
    flat = np.asarray(got, np.float64).reshape(-1)
    if flat.shape != wide.shape:
        return math.inf
    return float(np.linalg.norm(flat - wide)) / (float(np.linalg.norm(wide)) or 1.0)
