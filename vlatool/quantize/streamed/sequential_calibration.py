"""GPTQ and AWQ over a whole policy: layer after layer, each fed with what the quantized layers before it give."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.data import calibration_recording, takes_not_finite
from vlatool.errors import DataError, GraphError, require
from vlatool.quantize.calibration.samples import led_to, recorded_moments
from vlatool.quantize.streamed._activation_aware import Rounded, awq, gptq, nearest_codes
from vlatool.quantize.streamed._block_quantization import METHODS
from vlatool.quantize.streamed._graph_rewrite import Product, Task
from vlatool.quantize.streamed._journal import DATA
from vlatool.quantize.streamed._layer_executor import Layerwise, Values
from vlatool.quantize.streamed.options import WeightOptions
from vlatool.quantize.streamed.records import Record, Tools, padded
from vlatool.quantize.streamed.tensor_jobs import figures, piece, records_of, store, stored_meaning, whole_weight
from vlatool.quantize.streamed.weights_plan import WeightsPlan
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.program import draw
from vlatool.stage.base import SampleSet

Array = NDArray[Any]
FEW, MOST = 4096, 1024
"""Numbers of an observation up to which it is a state, and how many samples are taken of such ones."""
Sample = tuple[Mapping[str, Any], dict[str, Any]]
"""Observation, and what the policy keeps before it."""
SLACK = 2.0
"""How much more of a weight's norm a method may lose that spares the product instead."""


def calibrated_records(
    plan: WeightsPlan, bundle: Bundle, stage: WeightOptions, place: Path, seen: SampleSet
) -> list[Record]:
    """Return all records; those of quantized weights drive the policy from layer to layer and must run in order."""
    recording = calibration_recording(bundle, stage.calibration)
    numbers = recording.spread(_count(bundle, stage)) if recording is not None else []
    moments = recorded_moments(bundle, recording, numbers, seen) if recording is not None else ()
    walk = _Walk(plan, bundle, stage, place, list(led_to(bundle, moments)))
    records: list[Record] = []
    for number, task in enumerate(plan.tasks):
        if task.kind == "copy":
            records += records_of(task, stage.form, stage.choose, 0.0)
            continue
        records.append(Record(task.label, padded(task.size), partial(walk.fill, number), task.source.count, False))
    return records


def _count(bundle: Bundle, stage: WeightOptions) -> int:
    """Return how many samples to take, unless that was said: more where each has one row for a layer, and costs little.

    An image or a text has a row for each patch or token; a state has one, and a layer as wide as it needs as many
    samples as it has inputs.
    """
    inputs = bundle.manifest.spec.inputs
    numbers = all(tensor.kind != "text" and tensor.dtype.startswith("float") for tensor in inputs)
    sizes = [math.prod(axis for axis in tensor.shape if isinstance(axis, int)) for tensor in inputs]
    few = numbers and sum(sizes) <= FEW
    return MOST if few and "samples" not in stage.model_fields_set else stage.samples


class _Walk:
    """The policy on all samples, halted at each layer that is quantized."""

    def __init__(
        self, plan: WeightsPlan, bundle: Bundle, stage: WeightOptions, place: Path, samples: list[Sample]
    ) -> None:
        self._plan, self._bundle, self._stage, self._place = plan, bundle, stage, place
        self._samples = samples
        self._offsets = plan.offsets()
        self._wanted = -1
        self._shared = {id(layer): number for graph in plan.graphs.values() for layer, number in graph.products}
        owners: dict[int, int] = {}
        for layer, number in self._shared.items():
            owners.setdefault(number, layer)
        self._numbers = {layer: number for number, layer in owners.items()}
        self._target: Array = np.empty(0, np.uint8)
        self._note: dict[str, Any] | None = None
        self._steps: Iterator[None] | None = None

    def fill(self, number: int, tools: Tools, data: Array) -> dict[str, Any]:
        """Go on to the layer of a task, quantize it into its record, and return its figures."""
        self._wanted, self._target, self._note = number, data, None
        if self._steps is None:
            self._steps = self._walk(tools)
        for _ in self._steps:
            if self._note is not None:
                break
        if self._note is None:
            label = self._plan.tasks[number].label
            raise GraphError(
                f"The layer '{label}' was never run on the calibration samples, so its weights cannot be rounded by "
                f"{self._stage.method}.",
                "leave its graph out with --graphs, or use --method rtn or hqq, which need no activations",
            )
        return self._note

    def _walk(self, tools: Tools) -> Iterator[None]:
        manifest = self._bundle.manifest
        encode = ObservationEncoder(manifest.spec, self._bundle.path / "assets")
        random = np.random.default_rng(0)
        samples: list[Values] = [{**encode(observation), **kept} for observation, kept in self._samples]
        for step in manifest.program:
            for values in samples:
                _begin(step, values, random)
            graph = self._plan.graphs[step.graph]
            layers = [layer for layer, _ in graph.products]
            local = [{name: values[value] for name, value in step.feeds.items()} for values in samples]
            yield from Layerwise(graph.skeleton, layers, self._product).run(local, tools)
            for values, outputs in zip(samples, local, strict=True):
                values.update({value: outputs[name] for name, value in step.gives.items()})
                values.update({target: values[source] for source, target in step.carry.items()})

    def _product(self, layer: Product, rows: Array, tools: Tools) -> Array:
        number = self._numbers.get(id(layer))
        if number is None:  # a weight that was quantized for another layer: the float one serves
            return rows @ whole_weight(self._plan.tasks[self._shared[id(layer)]], tools).T
        task = self._plan.tasks[number]
        if number < self._wanted:
            with np.errstate(invalid="ignore"):
                return rows @ self._finished(task, number).T
        weight = whole_weight(task, tools)
        products = rows
        if takes_not_finite(self._bundle.manifest.spec):
            rows = rows[np.isfinite(rows).all(axis=1)]
        if not np.isfinite(rows).all() or not len(rows):
            raise DataError(
                f"The calibration samples make what the layer '{layer.node.name}' reads not finite.",
                "look at the samples and at the float32 policy: vlatool explain names where it begins",
            )
        rounded = self._round(weight, rows)
        self._store(task, rounded, self._target)
        self._note = _note(task, weight, rounded, rows, SLACK * self._stage.form.largest_error)
        with np.errstate(invalid="ignore"):  # what is not finite stays so
            return products @ rounded.meant.T

    def _round(self, weight: Array, rows: Array) -> Rounded:
        """Round by the method; to nearest where its activations make it lose more than the weights can spare."""
        torch: Any = require("torch", "build")
        method = gptq if self._stage.method == "gptq" else awq
        form, choose = self._stage.form, METHODS[self._stage.choose]
        with contextlib.suppress(torch.linalg.LinAlgError):
            rounded = method(weight, rows, form, choose)
            if np.linalg.norm(rounded.meant - weight) <= SLACK * form.largest_error * np.linalg.norm(weight):
                return rounded
        nearest = nearest_codes(weight, form, choose)
        return nearest if method is gptq else nearest._replace(inputs=np.ones(weight.shape[1], np.float32))

    def _store(self, task: Task, rounded: Rounded, data: Array) -> None:
        if task.kind == "blocks":
            piece(task, 0, data)[:] = rounded.codes.reshape(-1)
        store(task, self._stage.form, rounded.codes, rounded.scale, rounded.zero, data)
        if rounded.inputs is not None:
            piece(task, len(task.pieces) - 1, data)[:] = rounded.inputs.view(np.uint8)

    def _finished(self, task: Task, number: int) -> Array:
        """Return what an earlier run stored for a layer, as (columns, rows) float32."""
        with (self._place / DATA).open("rb") as stream:
            stream.seek(self._offsets[number])
            data = np.frombuffer(stream.read(task.size), np.uint8)
        return stored_meaning(task, data, self._stage.form)


def _begin(step: ProgramStep, values: Values, random: np.random.Generator) -> None:
    """Bring noise and the first entries of schedules into being."""
    for name, noise in step.noise.items():
        values[name] = draw(noise, random)
    for name, numbers in step.schedule.items():
        whole = all(isinstance(number, int) for number in numbers)
        values[name] = np.array([numbers[0]], np.int64 if whole else np.float32)


def _note(task: Task, weight: Array, rounded: Rounded, rows: Array, tolerance: float) -> dict[str, Any]:
    """Return the figures of a layer: what its weights and its products on the calibration samples lose."""
    difference = rounded.meant - weight
    lost, norm = float(np.vdot(difference, difference)), float(np.vdot(weight, weight))
    products = rows @ weight.T
    of_product = np.linalg.norm(rows @ difference.T) / (np.linalg.norm(products) or 1.0)
    note = figures(task, lost, norm, tolerance)
    seen = {"rows": len(rows), "inputs": weight.shape[1]}
    return {**note, "product_error": float(of_product), **seen, "sha256": ""}
