"""Features of the latency model: the work, the compute unit, and the precision."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from vlatool.graph.workload import PRECISIONS, TRAITS
from vlatool.latency_model.gaussian_process import KEYS, Rows
from vlatool.runtime.interface import Array

PROXIES = {"bfloat16": "float16", "float8": "int8"}
"""Precision -> precision whose published latencies stand for it."""
CENTRE = np.array([0.6, 1.8, 2.0, 4.0])
SPREAD = np.array([1.8, 0.6, 1.0, 0.6])
DEVICE_CENTRE = np.array([0.3, 4.3, 0.6, 2.0])
DEVICE_SPREAD = np.array([2.5, 1.1, 0.5, 0.9])
LAYER_MS = 0.03
"""Milliseconds for a layer at 1 GHz, before the fit's factor."""


@dataclass(frozen=True)
class Work:
    """Work of one run of a graph.

    Args:
        weights: Elements read from weights, counted at each read.
        activations: Elements that its compute layers write.
        name: Published name; unique for a user's own graph.
    """

    macs: float
    weights: float
    activations: float
    layers: float
    traits: frozenset[str] = frozenset()
    name: str = ""


@dataclass(frozen=True)
class ComputeUnit:
    """A unit of a device that computes.

    Args:
        device: Name of the board or processor; units with one name share what is known about it.
        unit: ``cpu``, ``gpu``, ``igpu`` or ``npu``.
        cores: Number of cores (threads) in use.
        peaks: Precision -> 10^12 operations per second, dense; at least one.
        setting: Other conditions of a measurement: power mode, threads, version.
        isa: Instruction set features of its cores, as in profiles: units with the same features inform each other.
    """

    device: str
    unit: str
    cores: float
    clock_ghz: float
    peaks: Mapping[str, float] = field(hash=False)
    bandwidth_gb_s: float
    setting: str = ""
    isa: str = ""

    def peak(self, precision: str) -> float:
        """Return the peak of a precision; for weight-only precisions that of float16, or float32."""
        computed = {"w4": "float16", "w8": "float16"}.get(precision, precision)
        chain = (computed, PROXIES.get(computed, computed), "float16" if computed in PROXIES else "float32", "float32")
        return next((self.peaks[name] for name in chain if name in self.peaks), max(self.peaks.values()))


@dataclass(frozen=True)
class Question:
    """A question to the model: the latency of this work on this compute unit.

    Args:
        runtime: Inference library.
        precision: A key of ``PRECISIONS``.
    """

    work: Work
    compute_unit: ComputeUnit
    runtime: str
    precision: str


@dataclass(frozen=True)
class Shares:
    """Prior shares of the peaks that are reached (0-1), and a factor on ``LAYER_MS``.

    Weights are read in one stream, activations are written and read in pieces: each has its own share of the bandwidth.
    """

    compute: float = 0.3
    activations: float = 0.27
    weights: float = 0.55
    layers: float = 1.0


def roofline_ms(question: Question, shares: Shares) -> float:
    """Return the sum of compute, memory and overhead in ms."""
    return sum(roofline_parts(question, shares).values())


def roofline_parts(question: Question, shares: Shares) -> dict[str, float]:
    """Return ``compute``, ``memory`` and ``overhead`` in ms (Williams, Waterman, Patterson, CACM 2009)."""
    work, compute_unit = question.work, question.compute_unit
    weight, activation = PRECISIONS[question.precision]
    moved = work.weights * weight / shares.weights + work.activations * activation / shares.activations
    return {
        "compute": 2e3 * work.macs / (compute_unit.peak(question.precision) * 1e12 * shares.compute),
        "memory": 1e3 * moved / (compute_unit.bandwidth_gb_s * 1e9),
        "overhead": work.layers / compute_unit.clock_ghz * LAYER_MS * shares.layers,
    }


def rows_of(questions: Iterable[Question], shares: Shares) -> Rows:
    """Return the rows of the process for some questions."""
    listed = list(questions)
    keys = [_keys(question) for question in listed]
    return Rows(
        {name: np.array([row[name] for row in keys], np.int64) for name in KEYS},
        np.array([_model(question.work) for question in listed]).reshape(-1, 4),
        np.array([[trait in question.work.traits for trait in TRAITS] for question in listed], float).reshape(-1, 5),
        np.array([_device(question) for question in listed]).reshape(-1, 4),
        np.log([roofline_ms(question, shares) for question in listed]),
    )


def _model(work: Work) -> Array:
    macs = math.log(max(work.macs, 1) / 1e9)
    others = (work.activations / 1e6, work.weights / 1e6, work.layers)
    activations, weights, layers = (math.log(max(value, 1e-6)) for value in others)
    return np.asarray((np.array([macs, activations - macs, weights - macs, layers - 0.3 * macs]) - CENTRE) / SPREAD)


def _device(question: Question) -> Array:
    unit = question.compute_unit
    values = (unit.peak(question.precision), unit.bandwidth_gb_s, unit.clock_ghz, unit.cores)
    return np.asarray((np.log(values) - DEVICE_CENTRE) / DEVICE_SPREAD)


def _keys(question: Question) -> dict[str, int]:
    compute_unit, runtime = question.compute_unit, question.runtime
    precision = PROXIES.get(question.precision, question.precision)
    work = question.work
    own = f"own {work.macs} {work.weights} {work.activations} {work.layers} {sorted(work.traits)}"
    name = f"{work.name} {work.macs:.3g}" if work.name else own
    unit = f"{compute_unit.device}/{compute_unit.unit}"
    core = f"{compute_unit.unit}/{' '.join(sorted(compute_unit.isa.split()))}" if compute_unit.isa else unit
    names = (
        compute_unit.unit, core, unit, runtime, f"{runtime} {precision}", f"{core} {runtime} {precision}",
        f"{unit} {runtime}", f"{unit} {runtime} {precision}", f"{unit} {runtime} {precision} {compute_unit.setting}",
        name, f"{name} {runtime} {precision}",
    )  # fmt: skip
    return {key: zlib.crc32(text.encode()) for key, text in zip(KEYS, names, strict=True)}
