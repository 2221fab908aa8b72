"""GPTQ and AWQ over a whole policy: layer after layer, each with the outputs of the quantized layers before it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.data import calibration_recording, takes_not_finite
from vlatool.errors import DataError, GraphError, require
from vlatool.quantize.calibration.samples import recorded_moments, samples_with_state
from vlatool.quantize.streamed._activation_aware import RoundedWeight, awq, gptq, round_to_nearest
from vlatool.quantize.streamed._block_quantization import METHODS
from vlatool.quantize.streamed._graph_rewrite import Product, Task
from vlatool.quantize.streamed._journal import DATA
from vlatool.quantize.streamed._layer_executor import LayerExecutor, Values
from vlatool.quantize.streamed.options import WeightOptions
from vlatool.quantize.streamed.records import Record, Tools, round_to_page
from vlatool.quantize.streamed.tensor_jobs import (
    dequantize_record,
    loss_figures,
    piece_bytes,
    read_weight,
    records_for,
    store_parameters,
)
from vlatool.quantize.streamed.weights_plan import WeightsPlan
from vlatool.runtime.interface import Array
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.program import draw
from vlatool.stage.record import SampleSet

MAX_STATE_SIZE, STATE_SAMPLES = 4096, 1024
"""Largest number of elements of a state observation, and number of samples for such observations."""
Sample = tuple[Mapping[str, Any], dict[str, Any]]
"""Observation, and the state that the policy keeps before it."""
LOSS_SLACK = 2.0
"""How much more of a weight's norm a method may lose that preserves the product instead."""


def calibrated_records(
    plan: WeightsPlan, bundle: Bundle, stage: WeightOptions, work_directory: Path, samples: SampleSet
) -> list[Record]:
    """Return all records; those of quantized weights run the policy from layer to layer and must stay in order."""
    recording = calibration_recording(bundle, stage.recording)
    numbers = recording.spread(_sample_count(bundle, stage)) if recording is not None else []
    moments = recorded_moments(bundle, recording, numbers, samples) if recording is not None else ()
    calibration = _SequentialCalibration(plan, bundle, stage, work_directory, list(samples_with_state(bundle, moments)))
    records: list[Record] = []
    for number, task in enumerate(plan.tasks):
        if task.kind == "copy":
            records += records_for(task, stage.block_format, stage.choose, 0.0)
            continue
        size, fill = round_to_page(task.size), partial(calibration.fill, number)
        records.append(Record(task.label, size, fill, task.source.count, False))
    return records


def _sample_count(bundle: Bundle, stage: WeightOptions) -> int:
    """Return the number of samples, more by default for states, which have one row for a layer and are cheap.

    An image or a text has a row for each patch or token; with one row, a layer needs as many samples as it has inputs.
    """
    inputs = bundle.manifest.spec.inputs
    numbers = all(tensor.kind != "text" and tensor.dtype.startswith("float") for tensor in inputs)
    sizes = [math.prod(axis for axis in tensor.shape if isinstance(axis, int)) for tensor in inputs]
    is_state = numbers and sum(sizes) <= MAX_STATE_SIZE
    return STATE_SAMPLES if is_state and "samples" not in stage.model_fields_set else stage.samples


class _SequentialCalibration:
    """A run of the policy on all samples, suspended at each quantized layer."""

    def __init__(
        self, plan: WeightsPlan, bundle: Bundle, stage: WeightOptions, work_directory: Path, samples: list[Sample]
    ) -> None:
        self._plan, self._bundle, self._stage, self._work_directory = plan, bundle, stage, work_directory
        self._samples = samples
        self._offsets = plan.offsets()
        self._target_task = -1
        self._shared = {id(layer): number for graph in plan.graphs.values() for layer, number in graph.products}
        owners: dict[int, int] = {}
        for layer, number in self._shared.items():
            owners.setdefault(number, layer)
        self._numbers = {layer: number for number, layer in owners.items()}
        self._target: Array = np.empty(0, np.uint8)
        self._figures: dict[str, Any] | None = None
        self._steps: Iterator[None] | None = None

    def fill(self, number: int, tools: Tools, data: Array) -> dict[str, Any]:
        """Advance to the layer of a task, quantize it into its record, and return its figures."""
        self._target_task, self._target, self._figures = number, data, None
        if self._steps is None:
            self._steps = self._run_policy(tools)
        for _ in self._steps:
            if self._figures is not None:
                break
        if self._figures is None:
            label = self._plan.tasks[number].label
            raise GraphError(
                f"The layer '{label}' was never run on the calibration samples, so its weights cannot be rounded by "
                f"{self._stage.method}.",
                "leave its graph out with --graphs, or use --method rtn or hqq, which need no activations",
            )
        return self._figures

    def _run_policy(self, tools: Tools) -> Iterator[None]:
        manifest = self._bundle.manifest
        encode = ObservationEncoder(manifest.spec, self._bundle.path / "assets")
        random = np.random.default_rng(0)
        samples: list[Values] = [{**encode(observation), **kept} for observation, kept in self._samples]
        for step in manifest.program:
            for values in samples:
                _initialize_inputs(step, values, random)
            graph = self._plan.graphs[step.graph]
            layers = [layer for layer, _ in graph.products]
            local = [{name: values[value] for name, value in step.feeds.items()} for values in samples]
            yield from LayerExecutor(graph.template, layers, self._multiply).run(local, tools)
            for values, outputs in zip(samples, local, strict=True):
                values.update({value: outputs[name] for name, value in step.gives.items()})
                values.update({target: values[source] for source, target in step.carry.items()})

    def _multiply(self, layer: Product, rows: Array, tools: Tools) -> Array:
        number = self._numbers.get(id(layer))
        if number is None:  # the weight was quantized for another layer: use the float one
            return rows @ read_weight(self._plan.tasks[self._shared[id(layer)]], tools).T
        task = self._plan.tasks[number]
        if number < self._target_task:
            with np.errstate(invalid="ignore"):
                return rows @ self._stored_weight(task, number).T
        weight = read_weight(task, tools)
        products = rows
        if takes_not_finite(self._bundle.manifest.spec):
            rows = rows[np.isfinite(rows).all(axis=1)]
        if not np.isfinite(rows).all() or not len(rows):
            raise DataError(
                f"The calibration samples make the input of the layer '{layer.node.name}' non-finite.",
                "look at the samples and at the float32 policy: vlatool explain names the first such layer",
            )
        rounded = self._round(weight, rows)
        self._store(task, rounded, self._target)
        self._figures = _layer_figures(task, weight, rounded, rows, LOSS_SLACK * self._stage.block_format.largest_error)
        with np.errstate(invalid="ignore"):  # non-finite values stay so
            return products @ rounded.restored.T

    def _round(self, weight: Array, rows: Array) -> RoundedWeight:
        """Round by the method; to nearest where its activations make it lose too much of the weight."""
        torch: Any = require("torch", "build")
        method = gptq if self._stage.method == "gptq" else awq
        form, choose = self._stage.block_format, METHODS[self._stage.choose]
        with contextlib.suppress(torch.linalg.LinAlgError):
            rounded = method(weight, rows, form, choose)
            if np.linalg.norm(rounded.restored - weight) <= LOSS_SLACK * form.largest_error * np.linalg.norm(weight):
                return rounded
        nearest = round_to_nearest(weight, form, choose)
        return nearest if method is gptq else nearest._replace(input_scale=np.ones(weight.shape[1], np.float32))

    def _store(self, task: Task, rounded: RoundedWeight, data: Array) -> None:
        if task.kind == "blocks":
            piece_bytes(task, 0, data)[:] = rounded.codes.reshape(-1)
        store_parameters(task, self._stage.block_format, rounded.codes, rounded.scale, rounded.zero, data)
        if rounded.input_scale is not None:
            piece_bytes(task, len(task.pieces) - 1, data)[:] = rounded.input_scale.view(np.uint8)

    def _stored_weight(self, task: Task, number: int) -> Array:
        """Return the weight that an earlier run stored for a layer, as (columns, rows) float32."""
        with (self._work_directory / DATA).open("rb") as stream:
            stream.seek(self._offsets[number])
            data = np.frombuffer(stream.read(task.size), np.uint8)
        return dequantize_record(task, data, self._stage.block_format)


def _initialize_inputs(step: ProgramStep, values: Values, random: np.random.Generator) -> None:
    """Add noise and the first entries of schedules to the values."""
    for name, noise in step.noise.items():
        values[name] = draw(noise, random)
    for name, numbers in step.schedule.items():
        whole = all(isinstance(number, int) for number in numbers)
        values[name] = np.array([numbers[0]], np.int64 if whole else np.float32)


def _layer_figures(task: Task, weight: Array, rounded: RoundedWeight, rows: Array, tolerance: float) -> dict[str, Any]:
    """Return the figures of a layer: the errors of its weights and of its products on the calibration samples."""
    difference = rounded.restored - weight
    lost, norm = float(np.vdot(difference, difference)), float(np.vdot(weight, weight))
    products = rows @ weight.T
    of_product = np.linalg.norm(rows @ difference.T) / (np.linalg.norm(products) or 1.0)
    note = loss_figures(task, lost, norm, tolerance)
    coverage = {"rows": len(rows), "inputs": weight.shape[1]}
    return {**note, "product_error": float(of_product), **coverage, "sha256": ""}
