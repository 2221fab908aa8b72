"""A small latency model, fitted on the made-up figures of ``published``, and policies that are made up, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from vlatool.graph.workload import GraphWorkload, Workload
from vlatool.latency_model.features import Shares, rows_of
from vlatool.latency_model.fit import conformal
from vlatool.latency_model.folds import Sample
from vlatool.latency_model.gaussian_process import Scales
from vlatool.latency_model.model import LatencyModel, TrainingData
from vlatool.latency_model.published_latencies import Point, read_points

Load = Callable[..., Workload]


@pytest.fixture(scope="session")
def points(points_template: Path) -> list[Point]:
    """The made-up figures; read only."""
    return read_points(points_template)


@pytest.fixture(scope="session")
def sample(points: list[Point]) -> Sample:
    """The figures of processors and GPUs."""
    return Sample.from_points([point for point in points if point.kind != "npu"])


@pytest.fixture(scope="session")
def model(points: list[Point]) -> LatencyModel:
    """A latency model that knows the made-up figures."""
    parts, bounds = {}, {}
    for part in ("processors", "npu"):
        mine = Sample.from_points([point for point in points if (point.kind == "npu") == (part == "npu")])
        parts[part] = TrainingData(rows_of(mine.questions, Shares()), mine.logs, Scales())
        bounds[part] = conformal(mine, Scales(), Shares())
    return LatencyModel(parts, dict.fromkeys(parts, Shares()), bounds, {"figures": len(points)})


@pytest.fixture(scope="session")
def load() -> Load:
    """A function that makes a policy of one graph: 10^9 multiply-accumulates, 10^6 weights, how they are stored."""

    def make(
        gmacs: float = 1.8, weights_m: float = 11.7, precision: str = "float32", runs: int = 1, **options: object
    ) -> Workload:
        size = {"float32": 4, "float16": 2}.get(precision, 1)
        fields = {
            "layers": 21, "weights": int(weights_m * 1e6), "activations": 2_500_000, "activation_bytes": 10_000_000,
            "weight_bytes": int(weights_m * 1e6) * size, "peak_bytes": 5_000_000,
        } | options  # fmt: skip
        return Workload({"main": GraphWorkload({precision: int(gmacs * 1e9)}, **fields)}, {"main": runs})  # type: ignore[arg-type]

    return make


@pytest.fixture(scope="session")
def certain(model: LatencyModel) -> LatencyModel:
    """The same model with narrow intervals, so that every runtime that it knows has an answer."""
    narrow = {part: {regime: dict.fromkeys(units, 0.1) for regime, units in each.items()}
              for part, each in model.conformal.items()}  # fmt: skip
    return replace(model, conformal=narrow)
