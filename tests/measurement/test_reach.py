"""The large product that a policy's speed is held against."""

import numpy as np
import pytest

from vlatool.errors import GraphError
from vlatool.measurement.reach import MACS, SIZE, Product, measure_reach, share_of_reach


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_the_product_in_float_is_the_product_of_its_operand(engine: str) -> None:
    pytest.importorskip("onnxruntime" if engine == "ort_cpu" else engine)
    opened = Product(engine, "float32", 1)
    wanted = 0.01 * opened._operand.astype(np.float64).sum(axis=1)
    assert np.allclose(opened.run()["y"][:, [0, -1]], wanted[:, None], atol=1e-3)


def test_the_product_in_int8_is_near_it_and_does_not_saturate() -> None:
    opened = Product("ort_cpu", "int8", 1)
    wanted = 0.01 * 50 * opened._operand.astype(np.float64).sum(axis=1)
    got = opened.run()["y"]
    assert got.shape == (SIZE, SIZE)
    assert np.abs(got - wanted[:, None]).max() < 0.2 + 0.01 * 50 * 0.01 * SIZE, (
        "a step of the result, and of the operand"
    )


def test_a_speed_is_that_of_its_multiply_accumulates(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter(range(0, 10**12, 10**9 // 4))
    monkeypatch.setattr("vlatool.measurement.reach.time.perf_counter_ns", lambda: next(ticks))
    assert measure_reach("ort_cpu", "float32", 1) == pytest.approx(MACS / 0.25 / 1e9)


def test_a_dtype_that_an_engine_lacks_is_refused() -> None:
    with pytest.raises(GraphError, match="bfloat16"):
        measure_reach("ort_cpu", "bfloat16", 1)


def test_the_share_adds_up_what_each_dtype_would_take() -> None:
    assert share_of_reach({"int8": 8e9, "float32": 1e9}, {"int8": 100.0, "float32": 50.0}, 0.2) == pytest.approx(0.5)
    assert share_of_reach({"int8": 8e9, "float16": 1e9}, {"int8": 100.0}, 0.2) is None
    assert share_of_reach({"int8": 8e9, "float16": 0}, {"int8": 100.0}, 0.16) == pytest.approx(0.5)
    assert share_of_reach({}, {}, 0.2) is None
