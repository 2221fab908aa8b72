"""What an engine reaches on a machine: a large matrix product, which the latency of a policy is held against.

A product of 1024 x 1024 x 1024 is large enough that nothing but its kernel counts, and small enough for the caches of a
board. In int8 it is standard QDQ with its quantizers, weights of which no pair saturates, as a policy has them.
"""

from __future__ import annotations

import base64
import contextlib
import time
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import GraphError
from vlatool.runtime.engine import BFLOAT16, FLOAT32, INT8, engine_class

SIZE = 1024
MACS = SIZE**3
DTYPES = (INT8, FLOAT32, BFLOAT16)
REPEATS = 5
"""Timed products of each dtype; the fastest counts, since other work only slows a product down."""
LIKELY_SHARE, POSSIBLE = 1.25, 4.0
"""Speed beside the large product's from which it is told, and beyond which no kernel is: OpenVINO's convolutions
reach 2.8 times the speed of its int8 products with AVX2."""
IN_FLOAT = (
    "eNrj4LJaxsilKcRYrMThnJ9XXJKYV6IlwcValphTmqrFw8EkwG7F0sDRwOHEsICRxYqBy5iLsViIsVyJH6baPy04I7EgFVkTowCjEgvXdWUbmCZh"
    "LsYKLsZyIcZKJTbfxBLf0hwrBiHG9ChRoLiQABcfB6MQFxcz0BYwkQQUrsQUdmLhYhAQAQA4GyFt"
)
"""An ONNX model, compressed: float32 ``x`` (1024, 1024) times a constant weight as ``y``."""
IN_INT8 = (
    "eNp10c9Kw0AQBvB8SbTrIHXZtuJJZFXEnMRjEA/VY4uIN28bGrVQYvO3bU55FB9Iz76Cj2GMDASMlz3M/Ga+gRXkfzl0rpBqcfMapZmJMu+Atgqz"
    "yENvV9iy57uVqMTYeoPrW3SmYFp0nylJaJc+j68YniqULThkKKTt2RWYnShELTZg1pOOB6uVGvyb+vE+uWZ4QUgVVnqP7d3Tw4tZht6IR3YEflZf"
    "8sQhYU0whFIh1v37vB6al+FkHoUmqftHhJj7My1vw7hDrBoRKRSdYkCYEQqFpd6emmyaL36Dl4SgWZx0Byfc33StVXh+HNXXK0l9AUXk1P/UPEFd"
    "3vwtj12y5PAbjGVwJw=="
)
"""The same with quantizers around both operands and the result; all weights are 50."""


def product(dtype: str) -> bytes:
    """Return the product as a serialized ``ModelProto``; for bfloat16 the one in float32, which the engine rounds."""
    return zlib.decompress(base64.b64decode(IN_INT8 if dtype == INT8 else IN_FLOAT))


class Product:
    """The product, open in an engine.

    Args:
        engine: name of the engine; the default one when empty.
        dtype: ``int8``, ``float32`` or ``bfloat16``.

    Raises:
        GraphError: when the engine refuses it, or does not compute in that dtype.
    """

    def __init__(self, engine: str, dtype: str, threads: int | None) -> None:
        compute = BFLOAT16 if dtype == BFLOAT16 else ""
        self._session = engine_class(engine)(Path(f"product-{dtype}.onnx"), threads, compute, product(dtype))
        self._operand = np.random.default_rng(0).uniform(-0.5, 0.5, (SIZE, SIZE)).astype(np.float32)

    def run(self) -> Mapping[str, Any]:
        """Compute it once."""
        outputs: Mapping[str, Any] = self._session.run({"x": self._operand})
        return outputs


def measure_reach(engine: str, dtype: str, threads: int | None) -> float:
    """Return how many 10^9 multiply-accumulates an engine does in a second in a dtype; raises as ``Product``."""
    opened = Product(engine, dtype, threads)
    opened.run()
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter_ns()
        opened.run()
        seconds.append((time.perf_counter_ns() - start) / 1e9)
    return MACS / min(seconds) / 1e9


def reach_by_dtype(engine: str, dtypes: Iterable[str], threads: int | None) -> dict[str, float]:
    """Return what an engine reaches in each of some dtypes, as far as it computes the product in them."""
    found: dict[str, float] = {}
    for dtype in set(dtypes).intersection(DTYPES):
        with contextlib.suppress(GraphError):
            found[dtype] = round(measure_reach(engine, dtype, threads), 3)
    return found


def share_of_reach(macs: Mapping[str, float], reach: Mapping[str, float], seconds: float) -> float | None:
    """Return which part of a time the work would take at the speed of the large products.

    Args:
        macs: dtype -> multiply-accumulates.
        reach: dtype -> 10^9 multiply-accumulates in a second.
        seconds: time that it took.

    Returns:
        A share, above 1 where another kernel is faster than that of the product; None where a dtype was not timed.
    """
    if not macs or seconds <= 0 or any(count and not reach.get(dtype) for dtype, count in macs.items()):
        return None
    return sum(count / reach[dtype] / 1e9 for dtype, count in macs.items() if count) / seconds
