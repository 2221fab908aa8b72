import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.errors import DataError, GraphError, RecipeError
from vlatool.graph.files import load, save
from vlatool.quantize.float16 import Float16
from vlatool.quantize.floats.float16_graph import nodes_touching, phase_nodes, to_float16, weight_losses
from vlatool.quantize.floats.overflow import find_overflows
from vlatool.sources.onnx import OnnxFile
from vlatool.stage.base import Context

HALF, FLOAT = TensorProto.FLOAT16, TensorProto.FLOAT


def node(kind: str, inputs: str, output: str, **attributes):
    return helper.make_node(kind, inputs.split(), output.split(), name=f"{output}/{kind}", **attributes)


def model_of(nodes: list, constants: dict[str, np.ndarray], outputs: tuple[str, ...] = ("y",)):
    made = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", FLOAT, [2, 4])],
        [helper.make_tensor_value_info(name, FLOAT, [2, 4]) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return model


def run(model, x: np.ndarray) -> list[np.ndarray]:
    """Compute in the types that the graph says; ONNX Runtime's processor kernels compute in float32 instead."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ReferenceEvaluator(model).run(None, {"x": x})


def types_of(model) -> dict[str, int]:
    inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
    return {value.name: value.type.tensor_type.elem_type for value in (*inferred.value_info, *inferred.output)}


def phases():
    """sin and cos of a large phase that depends on the input, multiplied into a product."""
    constants = {"w": np.eye(4, dtype=np.float32), "f": np.full(4, 700, np.float32), "b": np.full(4, 0.3, np.float32)}
    nodes = [
        node("Mul", "x f", "p"),
        node("Add", "p b", "q"),
        node("Sin", "q", "s"),
        node("Cos", "q", "c"),
        node("MatMul", "x w", "m"),
        node("Mul", "m s", "a"),
        node("Add", "a b", "d"),
        node("Mul", "d c", "y"),
    ]
    return model_of(nodes, constants)


@pytest.fixture(scope="module")
def half(float_bundle, tmp_path_factory) -> Bundle:
    """The tiny policy in float16; read only."""
    out = tmp_path_factory.mktemp("half") / "bundle"
    out.mkdir()
    return Float16(samples=8).run(float_bundle, out, Context()).bundle


def test_the_policy_runs_in_float16_near_float32(half, drift):
    assert Bundle.open(half.path) == half
    assert 0 < drift(half) < 3e-3
    assert half.manifest.graphs["main"].precision == {"float16": 1.0}
    assert half.manifest.made_by["calibration"]["samples"] == 8
    assert half.manifest.made_by["float16"]["beyond"] == []
    assert "nodes stay float32" in Float16().summarize(half)[0]


def test_inputs_and_outputs_keep_their_types_and_the_file_halves(half, float_bundle):
    models = [onnx.load(bundle.path / "graphs/main.onnx") for bundle in (float_bundle, half)]
    before, after = ([v.type.tensor_type.elem_type for v in (*m.graph.input, *m.graph.output)] for m in models)
    assert before == after
    sizes = [sum(len(tensor.raw_data) for tensor in model.graph.initializer) for model in models]
    assert sizes[1] < 0.55 * sizes[0]
    onnx.checker.check_model(models[1], full_check=True)


def test_equal_inputs_give_equal_bytes(quantized, half):
    assert quantized(Float16(samples=8)).hash == half.hash


def test_excluded_nodes_and_other_parts_stay_in_float32(quantized, drift):
    kept = quantized(Float16(samples=2, exclude=("blocks.0.mlp*",)))
    shares = kept.manifest.graphs["main"].precision
    assert 0.2 < shares["float32"] < 0.8
    assert drift(kept) < 3e-3
    part = quantized(Float16(samples=2, parts=("head",)))
    assert 0 < part.manifest.graphs["main"].precision["float16"] < 0.1
    with pytest.raises(RecipeError, match="No node matches"):
        quantized(Float16(samples=2, include=("nothing",)))


def test_a_quantized_bundle_is_refused(int8_bundle):
    with pytest.raises(Exception, match="int8"):
        Float16().check(int8_bundle, None)
    Float16().check(None, None)


def test_phases_are_computed_in_float32():
    model = phases()
    x = np.random.default_rng(0).normal(size=(2, 4)).astype(np.float32)
    (wanted,) = run(model, x)
    kept = phase_nodes(model)
    assert kept == {"p/Mul", "q/Add", "s/Sin", "c/Cos"}
    careless = to_float16(phases(), set())
    careful = to_float16(phases(), kept)
    assert np.abs(run(careless, x)[0] - wanted).max() > 0.05
    assert np.abs(run(careful, x)[0] - wanted).max() < 5e-3
    types = types_of(careful)
    assert {types[name] for name in ("p", "q")} == {FLOAT}
    assert types["m"] == HALF
    onnx.checker.check_model(careful, full_check=True)


def test_constants_that_kept_nodes_share_are_not_rounded():
    model = to_float16(phases(), phase_nodes(phases()))
    kinds = {tensor.name: tensor.data_type for tensor in model.graph.initializer}
    assert kinds == {"w": HALF, "f": FLOAT, "b": HALF, "b.float32": FLOAT}


def test_what_leads_to_an_index_stays_in_float32():
    nodes = [
        node("Mul", "x k", "s"),
        node("Cast", "s", "i", to=TensorProto.INT64),
        node("Cast", "i", "y", to=FLOAT),
    ]
    model = model_of(nodes, {"k": np.array(3000.7, np.float32)})
    assert phase_nodes(model) == {"s/Mul", "i/Cast"}


def test_large_values_and_outputs_of_kept_nodes_pass_in_float32():
    constants = {"big": np.array(1e5, np.float32), "small": np.array(1e-5, np.float32)}
    nodes = [node("Mul", "x big", "l"), node("Mul", "l small", "y"), node("Abs", "l", "z")]
    model = model_of(nodes, constants, ("y", "z"))
    x = np.full((2, 4), 3, np.float32)
    wanted = run(model, x)
    assert not np.isfinite(run(to_float16(model_of(nodes, constants, ("y", "z")), set()), x)[1]).all()
    kept = nodes_touching(model, ["l"])
    assert kept == {"l/Mul", "y/Mul", "z/Abs"}
    converted = to_float16(model, kept)
    for got, value in zip(run(converted, x), wanted, strict=True):
        np.testing.assert_array_equal(got, value)
    assert "Cast" not in {each.op_type for each in converted.graph.node}


def test_weights_beyond_float16_keep_their_nodes_and_small_ones_are_counted():
    w = np.eye(4, dtype=np.float32)
    w[0, 0], w[1, 2], w[2, 3] = 1e5, 1e-6, 1e-9
    model = model_of([node("MatMul", "x w", "m"), node("Add", "m s", "y")], {"w": w, "s": np.float32([1, 0, 1e-6, 0])})
    found = weight_losses(model, set())
    assert found.overflowing == ("m/MatMul",)
    assert found.subnormal == 1
    assert weight_losses(model, {"m/MatMul", "y/Add"}).subnormal == 0


def test_infinite_constants_are_no_reason_to_stay():
    mask = np.float32([0, -np.inf, 0, 0])
    model = model_of([node("Add", "x mask", "m"), node("Softmax", "m", "y")], {"mask": mask})
    assert weight_losses(model, set()).overflowing == ()
    (got,) = run(to_float16(model, set()), np.zeros((2, 4), np.float32))
    np.testing.assert_allclose(got, np.float32([[1 / 3, 0, 1 / 3, 1 / 3]] * 2), atol=1e-3)


def large_values(bundle: Bundle) -> None:
    """Let the mlp's first product be a million times as large and its second undo that, through a Relu-free path."""
    path = bundle.path / "graphs/main.onnx"
    model = load(path)
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    last = next(each for each in model.graph.node if each.name.startswith("head/"))
    for position, factor in ((1, 1e6), (2, 1e6)):
        tensor = constants[last.input[position]]
        tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor) * np.float32(factor), tensor.name))
    result = last.output[0]
    for each in model.graph.node:
        for place, name in enumerate(each.input):
            if name == result:
                each.input[place] = f"{result}.back"
    index = [each.name for each in model.graph.node].index(last.name)
    model.graph.initializer.append(numpy_helper.from_array(np.array(1e-6, np.float32), "back"))
    model.graph.node.insert(index + 1, helper.make_node("Mul", [result, "back"], [f"{result}.back"], name="back/Mul"))
    path.unlink()
    save(model, path)


def test_values_beyond_float16_are_named_and_stay_in_float32(float_bundle, copied, resealed, quantized, drift):
    bundle = copied(float_bundle)
    large_values(bundle)
    bundle = resealed(bundle)
    told: list[str] = []
    observations = recorded_observations(bundle, 4)
    found = find_overflows(bundle, ["main"], observations, 65504.0, Context())["main"]
    assert len(found) >= 1
    assert {each.sample for each in found.values()} == {0}
    out = bundle.path.with_name("half")
    out.mkdir()
    half = Float16(samples=4).run(bundle, out, Context(progress=lambda what, _share: told.append(what))).bundle
    assert drift(half) < 3e-3
    (first, *_) = half.manifest.made_by["float16"]["beyond"]
    assert first["graph"] == "main"
    assert first["value"] in found
    assert first["largest"] > 65504
    assert any(f"{first['value']} reaches" in what for what in told)
    assert any("beyond float16" in line for line in Float16().summarize(half))
    assert half.manifest.graphs["main"].precision["float32"] > 0


def test_a_sample_that_does_not_fit_is_named(float_bundle):
    observations = list(recorded_observations(float_bundle, 2))
    observations[1]["proprio"] = np.zeros(5, np.float32)
    with pytest.raises(DataError, match="Calibration sample 1"):
        find_overflows(float_bundle, ["main"], observations, 1.0, Context())


def test_the_calibration_file_is_an_input(tmp_path: Path):
    assert Float16().inputs() == ()
    assert Float16(calibration=tmp_path / "c.npz").inputs() == (tmp_path / "c.npz",)


def vector(*numbers: float) -> np.ndarray:
    return np.array(numbers, np.float32)


EYE = np.eye(4, dtype=np.float32)
TURNED = np.random.default_rng(0).normal(size=(4, 4)).astype(np.float32)
SMALL = {
    "weights": ([node("MatMul", "x w", "t"), node("Mul", "t s", "y")], {"w": TURNED * 1e-9, "s": vector(1e9)}),
    "scales": ([node("Mul", "x w", "t"), node("Mul", "t s", "y")], {"w": vector(1e-6), "s": vector(1e4)}),
    "both products": ([node("MatMul", "x w", "t"), node("MatMul", "t v", "y")], {"w": TURNED * 1e-7, "v": EYE * 6e4}),
    "addend": ([node("Mul", "x w", "t"), node("Add", "t b", "u"), node("Mul", "u s", "y")],
               {"w": vector(1e-8), "b": vector(1e-8, 2e-8, 3e-8, 4e-8), "s": vector(1e8)}),
    "one channel": ([node("Mul", "x w", "t"), node("Mul", "t s", "y")],
                    {"w": vector(1, 1e-9, 1, 1), "s": vector(1, 1e9, 1, 1)}),
    "division": ([node("Abs", "x", "a"), node("Mul", "a w", "t"), node("Div", "t d", "y")],
                 {"w": vector(1e-9), "d": vector(1e-9)}),
}  # fmt: skip
"""Graphs that compute ordinary numbers through small ones."""


def halved(folder: Path, nodes: list, constants: dict[str, np.ndarray], **options) -> tuple[Bundle, Bundle]:
    onnx.save(model_of(nodes, constants), folder / "a.onnx")
    for name in ("float", "half"):
        (folder / name).mkdir()
    bundle = OnnxFile(model=folder / "a.onnx").run(None, folder / "float", Context()).bundle
    return bundle, Float16(**options).run(bundle, folder / "half", Context()).bundle


def drifted(bundle: Bundle, half: Bundle) -> float:
    wide, narrow = (onnx.load(each.path / "graphs/main.onnx") for each in (bundle, half))
    random = np.random.default_rng(1)
    pairs = []
    for _ in range(24):
        feeds = {"x": random.normal(size=(1, 2, 4)).astype(np.float32)}
        pairs.append([ReferenceEvaluator(model).run(None, feeds)[0] for model in (wide, narrow)])
    return max(float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted)) for wanted, got in pairs)


@pytest.mark.parametrize("name", SMALL)
def test_small_numbers_that_matter_stay_float32(tmp_path: Path, name: str):
    nodes, constants = SMALL[name]
    bundle, half = halved(tmp_path, nodes, constants)
    assert drifted(bundle, half) < 0.01
    assert all(moved < 0.01 for moved in half.manifest.made_by["float16"]["moved"].values())


@pytest.mark.parametrize(
    ("constants", "named"),
    [
        ({"w": EYE, "b": vector(1e-9, 0, 0, 0)}, "addend"),
        ({"w": np.where(EYE > 0, EYE, 1e-8).astype(np.float32)}, "few"),
    ],
)
def test_small_numbers_that_change_nothing_do_not_keep_a_node(tmp_path: Path, constants, named):
    nodes = [node("MatMul", "x w", "m"), node("Add", "m b", "y") if named == "addend" else node("Neg", "m", "y")]
    _, half = halved(tmp_path, nodes, constants)
    assert half.manifest.made_by["float16"]["kept"] == 0


@pytest.mark.parametrize("epsilon", [1e-5, 1e-9, 1e-12])
def test_an_epsilon_does_not_become_zero(tmp_path: Path, epsilon: float):
    """What never changes is divided by its deviation, which is zero."""
    nodes = [
        node("Sub", "x x", "zero"), node("Mul", "zero zero", "v"), node("Add", "v e", "u"), node("Sqrt", "u", "r"),
        node("Add", "zero e", "top"), node("Div", "top r", "q"), node("Add", "x q", "y"),
    ]  # fmt: skip
    bundle, half = halved(tmp_path, nodes, {"e": vector(epsilon)})
    assert drifted(bundle, half) < 0.01
    plain = [node("Mul", "x x", "v"), node("Add", "v e", "u"), node("Sqrt", "u", "r"), node("Div", "x r", "y")]
    (tmp_path / "b").mkdir()
    _, half = halved(tmp_path / "b", plain, {"e": vector(epsilon)})
    stored = onnx.load(half.path / "graphs/main.onnx").graph.initializer
    floats = [numpy_helper.to_array(tensor) for tensor in stored if tensor.data_type in (FLOAT, HALF)]
    assert floats
    assert all((values != 0).all() for values in floats)


def test_an_opset_without_its_operators_is_refused(tmp_path: Path):
    value = helper.make_tensor_value_info
    made = helper.make_graph(
        [helper.make_node("MatMul", ["state", "w"], ["action"], "head")], "g",
        [value("state", TensorProto.FLOAT, [1, 16])], [value("action", TensorProto.FLOAT, [1, 6])],
        [numpy_helper.from_array(np.ones((16, 6), np.float32), "w")],
    )  # fmt: skip
    onnx.save(helper.make_model(made, opset_imports=[helper.make_opsetid("", 9)], ir_version=4), tmp_path / "old.onnx")
    for name in ("float", "half"):
        (tmp_path / name).mkdir()
    bundle = OnnxFile(model=tmp_path / "old.onnx", opset=9).run(None, tmp_path / "float", Context()).bundle
    with pytest.raises(GraphError, match="opset 9; float16 needs opset 10 or later") as refused:
        Float16().run(bundle, tmp_path / "half", Context())
    assert "vlatool export FILE.onnx --opset 13" in refused.value.fix


def test_what_still_moves_is_told():
    made = SimpleNamespace(manifest=SimpleNamespace(made_by={"float16": {
        "kept": 0, "subnormal_weights": 0, "beyond": [], "moved": {"main": 0.3, "other": 0.001},
    }}))  # fmt: skip
    lines = Float16().summarize(made)
    assert any("main: its outputs change by up to 0.3" in line for line in lines)
    assert not any("other" in line for line in lines)
