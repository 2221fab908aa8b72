"""Files as other tools write them: stored, they compute what ONNX Runtime computes from the file itself."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from _foreign_onnx import KINDS, write
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.runtime import load
from vlatool.sources._onnx_plain import plain
from vlatool.sources.onnx import OnnxFile
from vlatool.stage.base import Context

FLOAT32 = {"float32": 1.0}
INT8 = {
    "loop_of_products": 0.07, "loop_until": 0.111, "scan_of_products": 0.086, "branches_of_products": 0.314,
    "domains_and_functions": 0.407, "tf2onnx_constants": 1.0, "paddle_scale": 1.0, "identity_chain": 1.0,
    "bfloat16_inside": 1.0, "float16_inside": 1.0, "double_throughout": 1.0, "torch_script_gather": 0.5,
    "sparse_weight": 1.0,
}  # fmt: skip
"""File -> share of the multiply-accumulates that dynamic int8 reaches; bodies and foreign operators stay."""


def made(name: str, folder: Path) -> tuple[Bundle, Path, tuple[str, ...]]:
    path = write(name, folder)
    (folder / "out").mkdir()
    result = OnnxFile(model=path).run(None, folder / "out", Context())
    return result.bundle, path, result.messages


def observations(bundle: Bundle, count: int) -> list[dict[str, Any]]:
    random = np.random.default_rng(3)

    def value(tensor: TensorSpec) -> Any:
        whole, shape = np.dtype(tensor.dtype).kind in "iu", tensor.shape[1:]
        return np.asarray(random.integers(0, 100, shape) if whole else random.normal(size=shape), tensor.dtype)

    return [{tensor.name: value(tensor) for tensor in bundle.manifest.spec.inputs} for _ in range(count)]


def original(path: Path) -> Any:
    """Return what computes the file itself: ONNX Runtime, or onnx where that refuses it, or its products saturate."""
    try:
        if path.stem == "integer_products":
            raise NotImplementedError
        session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception:
        evaluator = ReferenceEvaluator(str(path))
        return lambda feeds: dict(zip(evaluator.output_names, evaluator.run(None, feeds), strict=True))
    names = [output.name for output in session.get_outputs()]
    return lambda feeds: dict(zip(names, session.run(names, feeds), strict=True))


@pytest.mark.parametrize("name", [name for name in KINDS if name != "strange_names"])
def test_it_computes_what_the_file_does(tmp_path: Path, name: str) -> None:
    bundle, path, _ = made(name, tmp_path)
    policy, run = load(bundle.path, threads=1), original(path)
    allowed = 0.02 if "float16" in name else 1e-5
    for observation in observations(bundle, 24):
        expected = run({key: value if not value.ndim else value[None] for key, value in observation.items()})
        outputs = policy.infer(observation).outputs
        for key, value in outputs.items():
            got, wanted = np.asarray(value, np.float64).reshape(-1), np.asarray(expected[key], np.float64).reshape(-1)
            assert np.linalg.norm(got - wanted) <= allowed * np.linalg.norm(wanted), key


@pytest.mark.parametrize("name", sorted(INT8))
def test_int8_leaves_what_it_does_not_reach_and_counts_it(tmp_path: Path, name: str) -> None:
    bundle, _, _ = made(name, tmp_path)
    assert bundle.manifest.graphs["main"].precision == FLOAT32
    (tmp_path / "int8").mkdir()
    quantized = DynamicInt8().run(bundle, tmp_path / "int8", Context()).bundle
    assert quantized.manifest.graphs["main"].precision.get("int8") == pytest.approx(INT8[name], abs=0.002)


@pytest.mark.parametrize(("name", "gone"), [("bfloat16_inside", "bfloat16"), ("double_throughout", "float64")])
def test_another_float_is_told(tmp_path: Path, name: str, gone: str) -> None:
    _, _, messages = made(name, tmp_path)
    assert f"layers compute in {gone}; the graph is converted to float32, which all stages start from" in messages


def test_names_of_all_kinds_stay(tmp_path: Path) -> None:
    bundle, _, _ = made("strange_names", tmp_path)
    spec = bundle.manifest.spec
    assert [tensor.name for tensor in (*spec.inputs, *spec.outputs)] == ["robot state/β.0", "the action"]
    assert load(bundle.path, threads=1).infer({"robot state/β.0": np.ones(16, np.float32)}).chunk.shape == (1, 6)


def test_a_scalar_and_narrow_integers_are_inputs_like_others(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    scalar, _, _ = made("scalar_ends", tmp_path / "a")
    assert [tensor.shape for tensor in scalar.manifest.spec.inputs] == [(1, 16), ()]
    policy, state = load(scalar.path, threads=1), np.ones(16, np.float32)
    whole, listed = policy.infer({"state": state, "rate": 2.0}), policy.infer({"state": state, "rate": [2.0]})
    np.testing.assert_array_equal(whole.chunk, listed.chunk)
    assert np.shape(whole.outputs["value"]) == ()
    narrow, _, _ = made("narrow_inputs", tmp_path / "b")
    assert [tensor.dtype for tensor in narrow.manifest.spec.inputs] == ["int8", "uint16"]


@pytest.mark.parametrize(("width", "stored"), [(8, ["w", "wt"]), (1024, ["w"])])
def test_a_weight_that_is_moved_is_stored_once_and_a_large_one_that_is_tied_stays_one(width, stored):
    weight = numpy_helper.from_array(np.ones((width, 512), np.float32), "w")
    moved = helper.make_node("Transpose", ["w"], ["wt"], perm=[1, 0])
    product = helper.make_node("MatMul", ["x", "wt"], ["y"])
    tied = helper.make_node("MatMul", ["y", "w"], ["z"])
    given = helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 512])
    for nodes, names in (([moved, product], ["wt"]), ([moved, product, tied], stored)):
        end = helper.make_tensor_value_info(nodes[-1].output[0], onnx.TensorProto.FLOAT, None)
        model = plain(helper.make_model(helper.make_graph(nodes, "g", [given], [end], [weight])))
        assert [tensor.name for tensor in model.graph.initializer] == names
