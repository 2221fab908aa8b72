"""The CUDA engine: refused where there is no card; on a card (skipped elsewhere) what it computes and refuses."""

import time
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest

import vlatool
from vlatool.bundle.bundle import Bundle
from vlatool.data import synthetic_observations
from vlatool.errors import GraphError, MissingExtra, VlatoolError
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.engines.ort_cuda import OrtCudaSession

PRODUCT = "g (float[512,512] a, float[512,512] b) => (float[512,512] y) { y = MatMul(a, b) }"
DET = "g (float[2,2] x) => (float d) { d = Det(x) }"
ENDLESS = """g (float[512,512] x) => (float[512,512] y) <int64 n = {4611686018427387904}, bool go = {1}> {
    y = Loop (n, go, x) <body = b (int64 i, bool on, float[512,512] v) => (bool more, float[512,512] w) {
        more = Identity(on) p = MatMul(v, v) w = Tanh(p) }> }"""


def is_usable() -> bool:
    try:
        return bool(OrtCudaSession.execution_providers())
    except VlatoolError:
        return False


with_card = pytest.mark.skipif(not is_usable(), reason="needs onnxruntime-gpu and a graphics card of NVIDIA")
without_card = pytest.mark.skipif(is_usable(), reason="this machine runs the CUDA engine")


def graph(folder: Path, text: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}'), str(folder / "graph.onnx"))
    return folder / "graph.onnx"


@without_card
def test_without_a_card_the_engine_is_refused_and_not_replaced_by_the_processor(float_bundle: Bundle) -> None:
    with pytest.raises((MissingExtra, GraphError), match="CUDAExecutionProvider") as caught:
        vlatool.load(float_bundle.path, engine="ort_cuda")
    assert "vlatool[cuda]" in caught.value.fix or "install the driver" in caught.value.fix


@with_card
def test_actions_on_the_card_are_those_of_the_processor(float_bundle: Bundle) -> None:
    card, processor = (vlatool.load(float_bundle.path, engine=engine, seed=0) for engine in ("ort_cuda", "ort_cpu"))
    assert 0 <= card.golden_error < 1e-4
    for observation in synthetic_observations(float_bundle, 30):
        expected = processor.infer(observation).outputs
        for name, value in card.infer(observation).outputs.items():
            np.testing.assert_allclose(value, expected[name], rtol=1e-3, atol=1e-4)


@with_card
def test_products_of_float32_are_not_computed_in_tf32(tmp_path: Path) -> None:
    a, b = np.random.default_rng(0).standard_normal((2, 512, 512)).astype(np.float32)
    result = OrtCudaSession(graph(tmp_path, PRODUCT), 1).run({"a": a, "b": b})["y"]
    exact = a.astype(np.float64) @ b.astype(np.float64)
    assert np.linalg.norm(result - exact) / np.linalg.norm(exact) < 1e-5  # TF32: 3e-4


@with_card
def test_a_node_that_the_card_does_not_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="CUDAExecutionProvider does not run Det"):
        OrtCudaSession(graph(tmp_path, DET), 1)


@with_card
def test_a_loop_without_an_end_is_stopped_and_the_card_works_on(tmp_path: Path) -> None:
    session = OrtCudaSession(graph(tmp_path, ENDLESS), 1)
    session.deadline = time.monotonic() + 0.5
    with pytest.raises(TimeoutError):
        session.run({"x": np.ones((512, 512), np.float32)})
    x = np.ones((512, 512), np.float32)
    assert OrtCudaSession(graph(tmp_path, PRODUCT), 1).run({"a": x, "b": x})["y"][0, 0] == 512


def test_its_identity_differs_from_that_of_the_processor() -> None:
    assert OrtCudaSession.identity().startswith("CUDAExecutionProvider {")
    assert OrtCpuSession.identity() == ""
