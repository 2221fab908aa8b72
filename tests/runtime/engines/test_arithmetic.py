"""The arithmetic probe: what it is, what it finds, and what an engine does about it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from vlatool.errors import GraphError
from vlatool.runtime import arithmetic
from vlatool.runtime.arithmetic import (
    EXACT,
    EXACT_BY_OPTION,
    EXACT_SUM,
    PRECISE_OPTION,
    SATURATING,
    SHAPE,
    SIGNED_OPTION,
    UNKNOWN,
    model,
    operand,
    ort_product,
)
from vlatool.runtime.engines import _reference, ort_cpu
from vlatool.runtime.engines._reference import ReferenceSession
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.stored_types import lacks_zero_point

SATURATED = 32767.0 * SHAPE[1] / 2
"""Pairs of products become 32,767 each."""


def integer_product(path: Path, kind: int) -> Path:
    """A file with a product of activations of a kind and int8 weights."""
    nodes = [helper.make_node("MatMulIntegerToFloat", ["a", "w", "s", "s"], ["y"], domain="com.microsoft")]
    graph = helper.make_graph(
        nodes, "product", [helper.make_tensor_value_info("a", kind, SHAPE)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, (16, 16))],
        [numpy_helper.from_array(np.full((64, 16), 127, np.int8), "w"), numpy_helper.from_array(np.float32(1), "s")],
    )  # fmt: skip
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=9), path)
    return path


def option(session: OrtCpuSession, name: str = PRECISE_OPTION[0]) -> str:
    return session._session.get_session_options().get_session_config_entry(name)


def test_the_probe_is_the_product_that_it_says():
    found = onnx.ModelProto.FromString(model())
    onnx.checker.check_model(found, full_check=True)
    weights = numpy_helper.to_array(found.graph.initializer[0])
    assert weights.dtype == np.int8
    assert (weights == 127).all()
    got = ReferenceEvaluator(found).run(None, {"x": operand()})[0]
    assert (got == EXACT_SUM).all()


def test_the_written_probe_is_the_same_product_as_an_integer_operator():
    found = onnx.ModelProto.FromString(model(written=True))
    onnx.checker.check_model(found, full_check=True)
    assert "MatMulInteger" in {node.op_type for node in found.graph.node}
    assert (ReferenceEvaluator(found).run(None, {"x": operand()})[0] == EXACT_SUM).all()
    assert ort_product(onnxruntime, precise=True, written=True) == EXACT_SUM
    assert ort_product(onnxruntime, written=True) == ort_product(onnxruntime)


@pytest.mark.parametrize("written", [False, True])
def test_the_probe_has_the_zero_points_without_which_older_releases_abort(written):
    assert not lacks_zero_point(model(written))


@pytest.mark.parametrize(
    ("release", "breaks"), [("1.23.2", True), ("1.29.0", True), ("1.30.0", False), ("2.0", False), ("", False)]
)
@pytest.mark.parametrize("engine", [OrtCpuSession, ReferenceSession])
def test_older_releases_do_not_get_the_option_that_ends_them(tmp_path, monkeypatch, engine, release, breaks):
    """ONNX Runtime 1.23 to 1.29 abort where a product without a zero point of its weights gets the option."""
    path = integer_product(tmp_path / "uint8.onnx", TensorProto.UINT8)
    monkeypatch.setattr(arithmetic, "ort_product", lambda *_, **given: EXACT_SUM if given.get("precise") else SATURATED)
    entries = []
    options = SimpleNamespace(add_session_config_entry=lambda *entry: entries.append(entry))
    for module in (ort_cpu, _reference):
        monkeypatch.setattr(module, "session_options", lambda *_: options)
    library = SimpleNamespace(__version__=release, GraphOptimizationLevel=onnxruntime.GraphOptimizationLevel)
    engine._option_sets(library, path, 1)
    assert (PRECISE_OPTION in entries) is not breaks


def test_with_the_option_products_are_exact_on_every_processor():
    assert ort_product(onnxruntime, precise=True) == EXACT_SUM


def test_what_a_processor_finds_is_exact_or_saturated():
    assert ort_product(onnxruntime) in (EXACT_SUM, SATURATED)


@pytest.mark.parametrize("engine", [OrtCpuSession, OpenvinoSession])
def test_an_engine_says_how_it_computes(engine):
    if engine is OpenvinoSession:
        pytest.importorskip("openvino")
    assert engine.arithmetic() in (EXACT, EXACT_BY_OPTION, SATURATING)


def test_openvino_is_asked_by_a_product_of_its_own(monkeypatch):
    """Weights whose product is not the one wanted stand for a processor that saturates."""
    pytest.importorskip("openvino")
    monkeypatch.setattr(arithmetic, "EXACT_SUM", EXACT_SUM + 1)
    assert OpenvinoSession.arithmetic() == SATURATING


@pytest.fixture
def saturating(monkeypatch):
    """A processor without VNNI: what it would compute is believed."""
    found = {False: SATURATED, True: EXACT_SUM}
    monkeypatch.setattr(arithmetic, "ort_product", lambda ort, precise=False, written=False: found[precise])
    return found


def test_where_products_saturate_the_option_is_set(tmp_path: Path, saturating):
    session = OrtCpuSession(integer_product(tmp_path / "product.onnx", TensorProto.UINT8), threads=1)
    assert option(session) == "1"
    assert (session.run({"a": np.full(SHAPE, 255, np.uint8)})["y"] == EXACT_SUM).all()
    assert OrtCpuSession.arithmetic() == EXACT_BY_OPTION
    saturating[True] = SATURATED
    assert OrtCpuSession.arithmetic() == SATURATING


def test_a_build_that_cannot_compute_the_product_opens_float32_all_the_same(tmp_path: Path, monkeypatch):
    ort_product.cache_clear()
    monkeypatch.setattr(arithmetic, "model", lambda written=False: b"no model")
    try:
        assert np.isnan(ort_product(onnxruntime))
        assert {OrtCpuSession.arithmetic(), ReferenceSession.arithmetic()} == {UNKNOWN}
        for engine in (OrtCpuSession, ReferenceSession):
            session = engine(integer_product(tmp_path / "product.onnx", TensorProto.INT8), threads=1)
            assert (session.run({"a": np.full(SHAPE, 127, np.int8)})["y"] == 127 * 127 * 64).all()
    finally:
        ort_product.cache_clear()


def test_openvino_that_cannot_compute_the_product_says_so(monkeypatch):
    pytest.importorskip("openvino")
    monkeypatch.setattr(arithmetic, "model", lambda written=False: b"no model")
    assert OpenvinoSession.arithmetic() == UNKNOWN


def level(session: OrtCpuSession) -> object:
    return session._session.get_session_options().graph_optimization_level


def test_where_products_saturate_the_reference_is_opened_so_that_they_are_exact(tmp_path: Path, saturating):
    """The option has no effect in a session that rewrites nothing."""
    levels = onnxruntime.GraphOptimizationLevel
    session = ReferenceSession(integer_product(tmp_path / "product.onnx", TensorProto.UINT8), threads=1)
    assert (option(session), level(session)) == ("1", levels.ORT_ENABLE_EXTENDED)
    assert (session.run({"a": np.full(SHAPE, 255, np.uint8)})["y"] == EXACT_SUM).all()
    assert ReferenceSession.arithmetic() == EXACT_BY_OPTION


def test_where_the_option_does_not_make_them_exact_the_reference_says_so_and_rewrites_nothing(
    tmp_path: Path, saturating
):
    saturating[True] = SATURATED
    session = ReferenceSession(integer_product(tmp_path / "product.onnx", TensorProto.UINT8), threads=1)
    assert level(session) == onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    assert ReferenceSession.arithmetic() == SATURATING


def test_the_reference_opens_signed_activations_all_the_same(tmp_path: Path, saturating):
    session = ReferenceSession(integer_product(tmp_path / "product.onnx", TensorProto.INT8), threads=1)
    assert (session.run({"a": np.full(SHAPE, 127, np.int8)})["y"] == 127 * 127 * 64).all()


def test_signed_activations_open_all_the_same_and_stay_signed(tmp_path: Path, saturating):
    """Beside such a product ONNX Runtime would rewrite convolutions of int8 to uint8, with which they saturate."""
    session = OrtCpuSession(integer_product(tmp_path / "product.onnx", TensorProto.INT8), threads=1)
    assert option(session, SIGNED_OPTION[0]) == "1"
    assert (session.run({"a": np.full(SHAPE, 127, np.int8)})["y"] == 127 * 127 * 64).all()


def test_the_first_error_is_told(tmp_path: Path, saturating):
    with pytest.raises(GraphError, match="refuses"):
        OrtCpuSession(integer_product(tmp_path / "product.onnx", TensorProto.FLOAT), threads=1)


def test_where_products_are_exact_nothing_is_set(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(arithmetic, "ort_product", lambda ort, precise=False, written=False: EXACT_SUM)
    session = OrtCpuSession(integer_product(tmp_path / "product.onnx", TensorProto.UINT8), threads=1)
    assert OrtCpuSession.arithmetic() == EXACT
    with pytest.raises(RuntimeError):
        option(session)
    reference = ReferenceSession(integer_product(tmp_path / "product.onnx", TensorProto.UINT8), threads=1)
    assert level(reference) == onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    assert ReferenceSession.arithmetic() == EXACT
