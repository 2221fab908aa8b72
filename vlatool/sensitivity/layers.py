"""Sensitivity of each layer: error of the actions with only this layer in int8, on recorded observations."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.data import Observations
from vlatool.errors import DataError, require
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import foreign_errors, save
from vlatool.graph.layers import Layer
from vlatool.graph.qdq import Range
from vlatool.machine.engine_calls import engine_call
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.runtime.engines import of_branches
from vlatool.runtime.interface import Action, Array
from vlatool.runtime.policy import Policy, relative_error
from vlatool.runtime.program import Program
from vlatool.sensitivity._switches import add_switches
from vlatool.stage.base import Context
from vlatool.stage.record import SampleSet

LayerId = tuple[str, str]
"""Graph name and layer name."""


@dataclass(frozen=True)
class LayerError:
    """Effect of int8 in one layer, or in a group of layers, on the actions.

    Args:
        name: Node name, for example ``blocks.3.attn.out/MatMul``; names joined by ``+`` for a group.
        error: Relative L2 error of the raw action output, mean over the observations.
        elements: Label -> mean |error| in physical units (un-normalised); empty for discrete actions.
        flips: Share of steps whose gripper element changes sign, or (discrete) whose largest logit is another one; 0
            when there is none.
        jump: ``|d' - d|₂ / |d|₂`` with ``d`` the raw last step minus the first of a chunk, mean over the observations:
            how far the start of the next chunk moves. 0 for chunks of one step and for discrete actions.
        macs_share: Share of the graph's multiply-accumulates (0-1); NaN when they cannot be counted.
        samples: Number of observations of the measurement.
    """

    name: str
    graph: str
    error: float
    elements: Mapping[str, float]
    flips: float
    jump: float
    macs_share: float
    samples: int = 0


def sensitivities(
    bundle: Bundle,
    stage: StaticInt8,
    ranges: Mapping[str, Mapping[str, Range]] | None,
    observations: Sequence[Mapping[str, Any]],
    context: Context,
    *,
    seconds: float = math.inf,
) -> list[LayerError]:
    """Measure every layer that a stage would quantize, with only this layer in int8; the worst first.

    The noise of each observation is drawn from the same seed. The state of a policy is that after the earlier
    observations in float32; zero where the observations are not from a recording.

    Args:
        stage: Stage that selects the layers and their style.
        ranges: Graph -> value -> (low, high), from ``ranges_of``; calibrated as the stage does when None. A missing
            graph gets its ranges at run time, as in dynamic int8.
        observations: Raw observations, at least one.
        seconds: Time limit; no further observation is started that would exceed it, except the first one.

    Raises:
        DataError: when there is no observation, or one does not fit the spec.
        GraphError: when a graph cannot be rewritten or run.
    """
    known = ranges_of(bundle, stage, context) if ranges is None else ranges
    with Switchboard(bundle, stage, known) as board:
        return board.errors([(layer_id,) for layer_id in board.shares], observations, context, seconds=seconds)


def ranges_of(bundle: Bundle, stage: StaticInt8, context: Context) -> dict[str, dict[str, Range]]:
    """Return graph -> value -> range (low, high) of the stage, from its calibration data.

    Raises:
        DataError: when the bundle has no calibration data, or a sample does not fit.
    """
    stage.check(bundle, None)
    _, values = stage.plan(bundle)
    statistics = stage.statistics(bundle, values, SampleSet(), context)
    return {graph: stage.ranges(values) for graph, values in statistics.items()}


class _OutputTape:
    """Outputs of the graphs in the float run of an observation, reusable up to the first changed graph."""

    def __init__(self) -> None:
        self.recorded: list[Mapping[str, Array]] = []
        self.recording = True
        self.position = 0
        self.changed = False

    def start(self, *, recording: bool) -> None:
        self.recording, self.position, self.changed = recording, 0, recording
        if recording:
            self.recorded.clear()


class _SwitchableSession:
    """A session of a graph with switches; it replays its outputs while nothing before it has changed."""

    def __init__(self, session: Any, flags: Mapping[str, str], tape: _OutputTape) -> None:
        self._session, self._flags, self._tape = session, flags, tape
        self._off = dict.fromkeys(flags.values(), np.array(False))
        self._set = self._off
        self._active = False

    def switch(self, layers: Iterable[str]) -> None:
        """Switch the given layers to int8 and all others to float32."""
        on = {self._flags[name]: np.array(True) for name in layers}
        self._set, self._active = {**self._off, **on}, bool(on)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph with its current switches."""
        tape = self._tape
        tape.changed = tape.changed or self._active
        if not tape.changed:
            tape.position += 1
            return tape.recorded[tape.position - 1]
        with engine_call(type(self._session), "ran a graph with switches"):
            outputs: Mapping[str, Any] = self._session.run({**feeds, **self._set})
        if tape.recording:
            tape.recorded.append(outputs)
        return outputs


class Switchboard:
    """A float32 policy that computes any of its layers in int8, in ``ranges`` of ``ranges_of``; a context manager."""

    def __init__(self, bundle: Bundle, stage: StaticInt8, ranges: Mapping[str, Mapping[str, Range]]) -> None:
        self._opened = contextlib.ExitStack()
        folder = self._opened.enter_context(scratch_directory())
        self._tape = _OutputTape()
        self._sessions: dict[str, _SwitchableSession] = {}
        self._state: Mapping[str, Array] = {}
        self.shares: dict[LayerId, float] = {}
        with foreign_errors("main"):
            layers, _ = stage.plan(bundle)
        for name, graph in bundle.manifest.graphs.items():
            path = bundle.file(graph.file)
            flags: dict[str, str] = {}
            if layers.get(name):
                with foreign_errors(name):
                    model, flags = add_switches(path, layers[name], ranges.get(name), stage.style)
                    self.shares.update({(name, layer): share for layer, share in _shares(path, layers[name]).items()})
                    path = folder / f"{name}.onnx"
                    save(model, path)
            with engine_call(of_branches(), f"opened the graph '{name}' with switches"):
                self._sessions[name] = _SwitchableSession(of_branches()(path), flags, self._tape)
        self.policy = Policy(bundle, Program(bundle.manifest.program, self._sessions, seed=0), DEFAULT_ENGINE)

    def __enter__(self) -> Switchboard:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def reference(self, observation: Mapping[str, Any]) -> Action:
        """Run in float32, and keep the outputs of the graphs for the following calls of ``run``."""
        return self._infer((), observation, recording=True)

    def run(self, layers: Iterable[LayerId], observation: Mapping[str, Any]) -> Action:
        """Run the observation of the last ``reference`` with the given layers in int8."""
        return self._infer(layers, observation, recording=False)

    def _infer(self, layers: Iterable[LayerId], observation: Mapping[str, Any], *, recording: bool) -> Action:
        selected = list(layers)
        for name, session in self._sessions.items():
            session.switch([layer for graph, layer in selected if graph == name])
        self._tape.start(recording=recording)
        self.policy.reset()
        if self._state:
            self.policy.program.kept_values = dict(self._state)
        return self.policy.infer(observation)

    def _with_state(self, observations: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
        """Yield observations; until the next one, each run starts from the policy's state before it."""
        if not (self.policy.program.keeps and isinstance(observations, Observations)):
            yield from observations
            return
        for moment in observations.with_history():
            self._state = {} if moment.begins else self._state
            if moment.counts:
                yield moment.observation
            self.reference(moment.observation)
            self._state = self.policy.program.kept_values
        self._state = {}

    def errors(
        self, groups: Sequence[Sequence[LayerId]], observations: Sequence[Mapping[str, Any]], context: Context, *,
        seconds: float = math.inf,
    ) -> list[LayerError]:  # fmt: skip
        """Return each group's error, the worst first, as ``sensitivities``; raises DataError without an observation."""
        if not observations:
            raise DataError(
                "No observations to measure the layers on.",
                "record some, and name them in policy.yaml: calibration: FILE.npz; see docs/guides/your-own-policy.md",
            )
        spec = self.policy.spec.action
        rows: list[list[tuple[Array, ...]]] = [[] for _ in groups]
        start = time.monotonic()
        for number, observation in enumerate(self._with_state(observations)):
            if number and (time.monotonic() - start) * (number + 1) / number > seconds:
                break
            reference = self.reference(observation)
            for index, group in enumerate(groups):
                done = (number * len(groups) + index) / (len(observations) * len(groups))
                context.progress(f"int8 in layer {index + 1} of {len(groups)}, all else in float32", done)
                rows[index].append(_compare(spec, self.run(group, observation), reference))
        layers = [self._error(group, row) for group, row in zip(groups, rows, strict=True)]
        return sorted(layers, key=lambda layer: -layer.error)

    def _error(self, group: Sequence[LayerId], rows: list[tuple[Array, ...]]) -> LayerError:
        spec = self.policy.spec.action
        errors, flips, jumps, elements = (np.mean([row[index] for row in rows], axis=0) for index in range(4))
        labels = spec.labels or tuple(str(index) for index in range(spec.width))
        named = {} if spec.kind == "discrete" else dict(zip(labels, elements.tolist(), strict=True))
        graphs = ", ".join(dict.fromkeys(graph for graph, _ in group))
        share = float(sum(self.shares[layer_id] for layer_id in group))
        name = "+".join(layer for _, layer in group)
        return LayerError(name, graphs, float(errors), named, float(flips), float(jumps), share, len(rows))


def _compare(spec: TensorSpec, got: Action, reference: Action) -> tuple[Array, ...]:
    """Return relative error, share of flips, relative change of the jump, and mean |error| of each element."""
    raw, before = (np.asarray(action.outputs[spec.name], np.float64) for action in (got, reference))
    error = np.array(relative_error(raw, before))
    if spec.kind == "discrete":
        return error, np.mean(got.chunk != reference.chunk), np.array(0.0), np.zeros(0)
    elements = np.abs(got.chunk.astype(np.float64) - reference.chunk).mean(axis=0)
    columns = [index for index, label in enumerate(spec.labels) if "grip" in label.lower()]
    flipped = (got.chunk[:, columns] > 0) != (reference.chunk[:, columns] > 0)
    steps, base = (steps_of.reshape(-1, steps_of.shape[-1]) for steps_of in (raw, before))
    jump = relative_error(steps[-1] - steps[0], base[-1] - base[0]) if len(base) > 1 else 0.0
    return error, np.array(flipped.mean() if columns else 0.0), np.array(jump), elements


def _shares(path: Path, layers: Iterable[Layer]) -> dict[str, float]:
    """Return layer name -> share of the graph's multiply-accumulates."""
    from vlatool.graph.macs import COMPUTE, node_macs
    from vlatool.graph.shapes import open_graph

    tensors = open_graph(require("onnx", "build"), path)
    macs = {node.name: node_macs(node, tensors) for node in tensors.nodes if node.op_type in COMPUTE}
    total = sum(count or 0 for count in macs.values()) or 1
    counts = {layer.name: macs.get(layer.name, 0) for layer in layers}
    return {name: float("nan") if count is None else count / total for name, count in counts.items()}
