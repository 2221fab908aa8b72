"""bfloat16 through OpenVINO: what the processor can, and a named refusal where it cannot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import onnx
import pytest
from _arithmetic import computes_bfloat16

from vlatool.bundle.bundle import Bundle
from vlatool.errors import BundleError, GraphError
from vlatool.quantize.bfloat16 import Bfloat16
from vlatool.quantize.int8 import convolutions
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load

COMPUTED = pytest.mark.needs("bfloat16", reason="the stage runs the bundle that it makes")


@pytest.fixture
def halved(quantized: Callable[..., Bundle]) -> Bundle:
    return quantized(Bfloat16())


def test_a_processor_without_bfloat16_refuses_by_name(quantized: Callable[..., Bundle]) -> None:
    if computes_bfloat16():
        assert quantized(Bfloat16()).manifest.graphs["main"].compute == "bfloat16"
    else:
        with pytest.raises(GraphError, match=r"OpenVINO computes .* in f32 on this CPU; wanted bf16"):
            quantized(Bfloat16())


@COMPUTED
def test_the_policy_stays_near_float(halved: Bundle, drift: Callable[..., float]) -> None:
    assert 1e-5 < drift(halved) < 0.05
    assert load(halved.path, threads=1).engine == "openvino"


@COMPUTED
def test_the_bundle_says_what_it_computes_in(halved: Bundle, float_bundle: Bundle) -> None:
    manifest = Bundle.open(halved.path).manifest
    assert manifest.engine == "openvino"
    assert {name: (graph.compute, graph.precision) for name, graph in manifest.graphs.items()} == {
        "main": ("bfloat16", {"bfloat16": 1.0})
    }
    assert manifest.parent == float_bundle.hash
    assert set(manifest.made_by["versions"]) == {*Bfloat16.packages}
    assert manifest.program == float_bundle.manifest.program


@COMPUTED
def test_the_weights_are_stored_as_they_were(halved: Bundle, float_bundle: Bundle) -> None:
    stored, before = (onnx.load(each.path / "graphs/main.onnx") for each in (halved, float_bundle))
    assert {tensor.name: tensor.raw_data for tensor in stored.graph.initializer} == {
        tensor.name: tensor.raw_data for tensor in before.graph.initializer
    }


@COMPUTED
def test_products_of_many_rows_may_be_convolutions(
    halved: Bundle,
    quantized: Callable[..., Bundle],
    drift: Callable[..., float],
    operators: Callable[[Bundle], dict[str, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(convolutions, "MIN_ROWS", 4)
    written = quantized(Bfloat16(convolutions=True))
    assert operators(written)["Conv"] > operators(halved)["Conv"]
    assert drift(written, halved) < drift(halved)
    assert drift(written) < 1.5 * drift(halved)


@COMPUTED
def test_another_engine_refuses_it(halved: Bundle) -> None:
    with pytest.raises(GraphError, match="ONNX Runtime on the CPU does not compute in bfloat16") as caught:
        load(halved.path, engine="ort_cpu")
    assert caught.value.fix == "use the engine openvino"


@COMPUTED
def test_equal_inputs_give_equal_graphs(halved: Bundle, quantized: Callable[..., Bundle]) -> None:
    names = [name for name in halved.manifest.files if name.startswith("graphs/")]
    again = quantized(Bfloat16())
    assert [halved.manifest.files[name] for name in names] == [again.manifest.files[name] for name in names]


@COMPUTED
def test_what_is_lower_already_is_refused(
    halved: Bundle, int8_bundle: Bundle, quantized: Callable[..., Bundle], tmp_path: Path
) -> None:
    for bundle, kind in ((int8_bundle, "int8"), (halved, "bfloat16")):
        for stage in (Bfloat16(), StaticInt8()):
            with pytest.raises(BundleError, match=f"The graph 'main' of .* is {kind} already") as caught:
                stage.check(bundle, None)
            assert "quantize the float32 bundle" in caught.value.fix
