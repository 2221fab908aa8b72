import re
import shlex
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, InputError, RecipeError, SourceError
from vlatool.graph.layers import find_layers
from vlatool.graph.workload import graph_workload
from vlatool.runtime import load
from vlatool.sources import is_bundle, source_stage
from vlatool.sources.onnx import OnnxFile
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage


def build(out: Path, model: Path, **options: object) -> Bundle:
    out.mkdir()
    return OnnxFile(model=model, **options).run(None, out, Context()).bundle


def linear(path: Path, shape: object = (1, 3), dtype: int = TensorProto.FLOAT, op: str = "MatMul") -> Path:
    """An ONNX file ``y = x @ w``."""
    weight = numpy_helper.from_array(np.arange(6, dtype=np.float32).reshape(3, 2), "w")
    node = helper.make_node(op, ["x", "w"], ["y"])
    result = helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 2))
    graph = helper.make_graph([node], "main", [helper.make_tensor_value_info("x", dtype, shape)], [result], [weight])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), path)
    return path


def test_the_spec_comes_from_the_file(tmp_path: Path):
    bundle = build(tmp_path / "out", linear(tmp_path / "walker.onnx"), control_hz=25)
    assert bundle.manifest.name == "walker"
    assert bundle.manifest.spec.control_hz == 25
    assert bundle.manifest.spec.inputs[0].shape == (1, 3)
    assert bundle.manifest.graphs["main"].opset == 20
    assert bundle.manifest.made_by["options"] == {"model": "walker.onnx"}
    policy = load(bundle.path, threads=1)
    np.testing.assert_allclose(policy.infer({"x": [1.0, 0.0, 1.0]}).chunk, [[4, 6]])


def test_a_free_batch_axis_is_one_and_other_free_axes_keep_their_names(tmp_path: Path):
    path = linear(tmp_path / "a.onnx", ("batch", 3))
    assert build(tmp_path / "out", path).manifest.spec.inputs[0].shape == (1, 3)
    path = linear(tmp_path / "b.onnx", (None, 3))
    assert build(tmp_path / "other", path).manifest.spec.inputs[0].shape == (1, 3)


def test_initializers_that_are_listed_as_inputs_are_no_inputs(tmp_path: Path):
    path = linear(tmp_path / "old.onnx")
    model = onnx.load(path)
    model.graph.input.append(helper.make_tensor_value_info("w", TensorProto.FLOAT, (3, 2)))
    onnx.save(model, path)
    assert [tensor.name for tensor in build(tmp_path / "out", path).manifest.spec.inputs] == ["x"]


@pytest.mark.parametrize("form", ["folder", "file"])
def test_a_description_gives_spec_assets_and_data(
    tmp_path: Path, onnx_file, policy_dir, float_bundle, observation, form
):
    policy = policy_dir if form == "folder" else policy_dir / "policy.yaml"
    bundle = build(tmp_path / "out", onnx_file, policy=policy)
    assert bundle.manifest.spec == float_bundle.manifest.spec
    assert {"assets/vocabulary.json", "data/calibration.npz", "data/evaluation.npz"} <= set(bundle.manifest.files)
    wanted = load(float_bundle.path, threads=1).infer(observation).chunk
    np.testing.assert_allclose(load(bundle.path, threads=1).infer(observation).chunk, wanted, rtol=1e-6)


def test_a_description_that_names_what_the_file_lacks(tmp_path: Path, policy_dir):
    with pytest.raises(SourceError, match="The ONNX file has no 'image', which the spec names; known: x"):
        build(tmp_path / "out", linear(tmp_path / "a.onnx"), policy=policy_dir)


def test_external_data_comes_along(tmp_path: Path, onnx_file, policy_dir, float_bundle, observation):
    model = onnx.load(onnx_file)
    outside = tmp_path / "outside"
    outside.mkdir()
    onnx.save(model, outside / "big.onnx", save_as_external_data=True, location="big.onnx.data", size_threshold=0)
    assert (outside / "big.onnx.data").stat().st_size > 0
    stage = OnnxFile(model=outside / "big.onnx", policy=policy_dir)
    assert outside / "big.onnx.data" in stage.inputs()
    bundle = build(tmp_path / "out", outside / "big.onnx", policy=policy_dir)
    wanted = load(float_bundle.path, threads=1).infer(observation).chunk
    np.testing.assert_allclose(load(bundle.path, threads=1).infer(observation).chunk, wanted, rtol=1e-6)


def test_external_data_that_is_missing(tmp_path: Path, onnx_file):
    onnx.save(onnx.load(onnx_file), tmp_path / "big.onnx", save_as_external_data=True, location="d", size_threshold=0)
    (tmp_path / "d").unlink()
    with pytest.raises(SourceError, match=r"big.onnx is not a readable ONNX file"):
        build(tmp_path / "out", tmp_path / "big.onnx")


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(SourceError, match="No such ONNX file"):
        OnnxFile(model=tmp_path / "absent.onnx").check(None, None)


@pytest.mark.parametrize("content", [b"", b"nonsense " * 50, b"\x08"], ids=["empty", "nonsense", "half"])
def test_a_corrupt_file(tmp_path: Path, content):
    (tmp_path / "a.onnx").write_bytes(content)
    with pytest.raises(SourceError, match=r"a.onnx is not a"):
        build(tmp_path / "out", tmp_path / "a.onnx")


@pytest.mark.parametrize(
    ("dtype", "name"), [(TensorProto.STRING, "string"), (TensorProto.COMPLEX64, "complex64"), (17, "float8e4m3fn")]
)
def test_a_dtype_that_no_spec_has_is_refused_by_name(tmp_path: Path, dtype: int, name: str) -> None:
    with pytest.raises(SourceError, match=f"The input 'x' has the type {name}; allowed: .*float64") as caught:
        build(tmp_path / "out", linear(tmp_path / "a.onnx", dtype=dtype))
    assert "where it is made" in caught.value.fix


def test_an_output_that_is_no_tensor_is_left_out_by_a_description(tmp_path: Path) -> None:
    path = linear(tmp_path / "a.onnx")
    model = onnx.load(path)
    model.graph.node.append(helper.make_node("SequenceConstruct", ["y"], ["parts"]))
    model.graph.output.append(helper.make_tensor_sequence_value_info("parts", TensorProto.FLOAT, None))
    onnx.save(model, path)
    with pytest.raises(SourceError, match="The output 'parts' has the type sequence") as caught:
        build(tmp_path / "out", path)
    assert "zipmap" in caught.value.fix
    (tmp_path / "policy.yaml").write_text(
        "name: w\nspec:\n  inputs: [{name: x, shape: [1, 3]}]\n  outputs: [{name: y, shape: [1, 2]}]\n  control_hz: 9\n"
    )
    bundle = build(tmp_path / "other", path, policy=tmp_path)
    np.testing.assert_allclose(load(bundle.path, threads=1).infer({"x": [1.0, 0.0, 1.0]}).chunk, [[4, 6]])


def test_a_shape_that_no_observation_has(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="'x' has the shape"):
        build(tmp_path / "out", linear(tmp_path / "a.onnx", shape=(1, 0)))


def test_an_operator_that_the_engine_does_not_know(tmp_path: Path):
    with pytest.raises(SourceError, match="has the operator NoSuchOperator at 'y', which no engine has"):
        build(tmp_path / "out", linear(tmp_path / "a.onnx", op="NoSuchOperator"))


@pytest.mark.parametrize("domain", ["", "of.somebody", "com.microsoft"])
def test_a_refusal_names_the_file_and_not_its_copy(tmp_path: Path, domain: str) -> None:
    path = linear(tmp_path / "walker.onnx", op="NoSuchOperator")
    model = onnx.load(path)
    model.graph.node[0].domain = domain
    onnx.save(model, path)
    with pytest.raises(InputError) as caught:
        build(tmp_path / "out", path)
    assert str(path) in caught.value.message
    assert str(tmp_path / "out") not in str(caught.value)
    assert caught.value.fix


def test_a_rate_must_be_above_zero(tmp_path: Path):
    with pytest.raises(RecipeError, match="control_hz"):
        build_stage("sources.onnx", {"model": tmp_path / "a.onnx", "control_hz": 0})


def test_a_file_whose_action_has_a_time_axis_is_a_chunk_of_which_one_action_is_executed(tmp_path: Path):
    path = tmp_path / "chunked.onnx"
    graph = helper.make_graph(
        [helper.make_node("Neg", ["x"], ["y"])],
        "main",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 8, 7))],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 8, 7))],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), path)
    bundle = build(tmp_path / "out", path)
    assert (bundle.manifest.spec.chunk, bundle.manifest.spec.execute) == (8, 1)
    assert load(bundle.path, threads=1).infer({"x": np.ones((8, 7))}).chunk.shape == (8, 7)


@pytest.mark.parametrize(
    ("output", "told"),
    [
        ("{name: y, shape: [1, 3], kind: discrete, labels: [a, b, c]}", r"float32 \[1, 3\].*float32 \[1, 2\]"),
        ("{name: y, shape: [1, 2], dtype: float16}", r"float16 \[1, 2\].*float32 \[1, 2\]"),
    ],
    ids=["labels", "dtype"],
)
def test_a_description_that_the_file_does_not_fit_is_not_sealed(tmp_path: Path, output, told):
    (tmp_path / "policy.yaml").write_text(
        f"name: walker\nspec:\n  inputs: [{{name: x, shape: [1, 3]}}]\n  outputs: [{output}]\n  control_hz: 10\n"
    )
    with pytest.raises(GraphError, match=told):
        build(tmp_path / "out", linear(tmp_path / "walker.onnx"), policy=tmp_path / "policy.yaml")


def reshaped(path: Path, shape: object = ("batch", "rows", 4), opset: int = 17) -> Path:
    """An ONNX file that reads its own batch: ``y = (x @ w)``, reshaped to [batch, 2, ...] as exporters write it."""
    weight = numpy_helper.from_array(np.arange(8, dtype=np.float32).reshape(4, 2), "w")
    rest = numpy_helper.from_array(np.array([2, -1], np.int64), "rest")
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["m"], name="product"),
        helper.make_node("Shape", ["x"], ["n"], start=0, end=1),
        helper.make_node("Concat", ["n", "rest"], ["wanted"], axis=0),
        helper.make_node("Reshape", ["m", "wanted"], ["y"]),
    ]
    result = helper.make_tensor_value_info("y", TensorProto.FLOAT, (shape[0], 2, None))  # type: ignore[index]
    given = helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "main", [given], [result], [weight, rest])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8), path)
    return path


def shapes(bundle: Bundle) -> tuple[list[int], list[int]]:
    graph = onnx.load(bundle.path / "graphs/main.onnx").graph
    (found, given) = (
        [axis.dim_value for axis in each.type.tensor_type.shape.dim] for each in (graph.input[0], graph.output[0])
    )
    return found, given


FREE = [((None, "rows", 4), "rows"), ((1, -1, 4), "n1"), (("batch", None, 4), "n1"), (("b", "h w", 4), "h w")]


@pytest.mark.parametrize(("shape", "named"), FREE)
def test_free_axes_other_than_the_batch_are_asked_for_by_name(tmp_path: Path, shape: object, named: str) -> None:
    path = reshaped(tmp_path / "a b.onnx", shape)
    with pytest.raises(SourceError, match=f"'x' has the free axes {named} in its shape") as caught:
        build(tmp_path / "out", path)
    option = next(word for word in shlex.split(caught.value.fix) if word.startswith("x="))
    numbers = re.sub("^x=(b|batch|n0),", "x=1,", option).replace(re.sub(r"\W", "_", named), "6")
    bundle = build(tmp_path / "other", path, shape=(numbers,))
    assert shapes(bundle) == ([1, 6, 4], [1, 2, 6])
    assert bundle.manifest.made_by["options"]["shape"] == [numbers]
    again = OnnxFile(model=path).as_recorded(dict(bundle.manifest.made_by), bundle)
    assert again.shape == (numbers,)


def test_an_axis_can_stay_free_by_name(tmp_path: Path) -> None:
    bundle = build(tmp_path / "out", reshaped(tmp_path / "a.onnx"), shape=("x=1,rows,4",))
    assert bundle.manifest.spec.inputs[0].shape == (1, "rows", 4)
    assert load(bundle.path, threads=1).infer({"x": np.ones((3, 4), np.float32)}).outputs["y"].shape == (1, 2, 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x", "not a shape"), ("x=1,,4", "not a shape"), ("x=1,0,4", "not a shape"), ("y=1,6,4", "input.*known: x"),
        ("x=1,6", "the file has"), ("x=1,6,5", "the file has"), ("=1,6,4", "not a shape"), ("x=1,-6,4", "not a shape"),
    ],
)  # fmt: skip
def test_a_shape_that_does_not_fit_the_file(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(SourceError, match=said):
        build(tmp_path / "out", reshaped(tmp_path / "a.onnx"), shape=(text,))


@pytest.mark.parametrize("opset", [7, 9, 11, 12])
def test_an_old_opset_is_raised_so_that_int8_can_be_written(tmp_path: Path, opset: int) -> None:
    path = linear(tmp_path / "a.onnx")
    model = onnx.load(path)
    model.opset_import[0].version, model.ir_version = opset, 6
    onnx.save(model, path)
    (tmp_path / "out").mkdir()
    result = OnnxFile(model=path).run(None, tmp_path / "out", Context())
    assert result.bundle.manifest.graphs["main"].opset == 13
    assert result.messages == (f"converted from opset {opset} to 13; the same on 32 observations",)
    assert len(find_layers(onnx.load(result.bundle.path / "graphs/main.onnx"), ("MatMul",))) == 1


def test_an_old_opset_that_onnx_cannot_raise_stays_and_is_told(tmp_path: Path) -> None:
    path = linear(tmp_path / "a.onnx")
    model = onnx.load(path)
    model.graph.node[0].output[0] = "m"
    model.graph.node.append(helper.make_node("Upsample", ["m", "s"], ["y"], mode="nearest"))
    model.graph.initializer.append(numpy_helper.from_array(np.ones(2, np.float32), "s"))
    model.opset_import[0].version, model.ir_version = 9, 6
    onnx.save(model, path)
    (tmp_path / "out").mkdir()
    result = OnnxFile(model=path).run(None, tmp_path / "out", Context())
    opset = result.bundle.manifest.graphs["main"].opset
    with pytest.raises(GraphError, match="opset 9; int8 needs opset 13") as caught:
        find_layers(onnx.load(path), ("MatMul",))
    assert "--opset" in caught.value.fix
    assert opset == 13 or result.messages[0].startswith("opset 9 stays")


@pytest.mark.parametrize("batch", ["batch", None, -1, 0])
def test_the_batch_axis_of_the_graph_is_fixed_to_one(tmp_path: Path, batch: object) -> None:
    said: list[str] = []
    path = reshaped(tmp_path / "a.onnx", (batch, 6, 4))
    (tmp_path / "out").mkdir()
    bundle = OnnxFile(model=path).run(None, tmp_path / "out", Context(lambda text, _share: said.append(text))).bundle
    assert shapes(bundle) == ([1, 6, 4], [1, 2, 6])
    assert "free axes get a length: x axis 0 = 1" in said
    assert graph_workload(bundle.path / "graphs/main.onnx").macs == {"float32": 6 * 4 * 2}
    observation = {"x": np.ones((1, 6, 4), np.float32)}
    wanted = load(bundle.path, threads=1).infer(observation).chunk
    np.testing.assert_allclose(
        load(bundle.path, threads=1, engine="openvino").infer(observation).chunk, wanted, rtol=1e-5
    )


def test_other_free_axes_get_the_lengths_of_the_description(tmp_path: Path) -> None:
    (tmp_path / "policy.yaml").write_text(
        "name: free\nspec:\n  inputs: [{name: x, shape: [1, 6, 4]}]\n  outputs: [{name: y, shape: [1, 2, 6]}]\n"
        "  control_hz: 10\n  chunk: 2\n"
    )
    path = reshaped(tmp_path / "a.onnx")
    assert shapes(build(tmp_path / "out", path, policy=tmp_path)) == ([1, 6, 4], [1, 2, 6])


def test_an_opset_that_is_asked_for_is_converted_to(tmp_path: Path) -> None:
    bundle = build(tmp_path / "out", reshaped(tmp_path / "a.onnx", (1, 6, 4), opset=17), opset=20)
    assert bundle.manifest.graphs["main"].opset == 20
    assert onnx.load(bundle.path / "graphs/main.onnx").opset_import[0].version == 20
    assert bundle.manifest.made_by["options"]["opset"] == 20


def test_an_opset_that_cannot_be_converted_to_says_why(tmp_path: Path) -> None:
    path = linear(tmp_path / "a.onnx", op="Gelu")
    model = onnx.load(path)
    del model.graph.node[0].input[1:]
    onnx.save(model, path)
    with pytest.raises(SourceError, match=r"has opset 20, which onnx cannot convert to 17: .*Gelu") as caught:
        build(tmp_path / "out", path, opset=17)
    assert "leave --opset out" in caught.value.fix


@pytest.mark.parametrize("described", [False, True])
def test_a_directory_with_an_onnx_file_is_told_to_name_the_file(tmp_path: Path, described: bool) -> None:
    path = linear(tmp_path / "walker.onnx")
    if described:
        (tmp_path / "policy.yaml").write_text(
            "name: w\nspec:\n  inputs: [{name: x, shape: [1, 3]}]\n  outputs: [{name: y, shape: [1, 2]}]\n"
            "  control_hz: 9\n"
        )
    with pytest.raises(SourceError, match=r"holds ONNX files \(walker.onnx\)") as caught:
        source_stage(str(tmp_path)).check(None, None)
    assert str(path) in caught.value.fix
    assert "--factory" not in str(caught.value)
    assert not is_bundle(str(tmp_path))


def drawing(path: Path, inside: bool = False) -> Path:
    """An ONNX file that adds normal noise to what it reads, in a branch where ``inside``."""
    noise = helper.make_node("RandomNormalLike", ["x"], ["n"])
    nodes = [noise]
    if inside:
        value = helper.make_tensor_value_info("n", TensorProto.FLOAT, (1, 3))
        branches = [helper.make_graph([noise], name, [], [value]) for name in ("then", "else")]
        always = numpy_helper.from_array(np.array(True), "always")
        nodes = [
            helper.make_node("Constant", [], ["always"], value=always),
            helper.make_node("If", ["always"], ["n"], then_branch=branches[0], else_branch=branches[1]),
        ]
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, 3)) for name in ("x", "y"))
    graph = helper.make_graph([*nodes, helper.make_node("Add", ["x", "n"], ["y"])], "main", [x], [y])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), path)
    return path


@pytest.mark.parametrize(("inside", "times"), [(False, "once"), (True, "2 times")])
def test_a_file_that_draws_random_numbers_is_refused(tmp_path: Path, inside: bool, times: str) -> None:
    path = drawing(tmp_path / "a.onnx", inside)
    with pytest.raises(GraphError, match=rf"a.onnx draws random numbers, {times} .*\(RandomNormalLike\)") as caught:
        build(tmp_path / "out", path)
    assert "noise: {noise: {shape: [" in caught.value.fix
    assert "distribution: normal" in caught.value.fix


def noisy(folder: Path, graph: str = "main") -> Path:
    """The same with the noise as an input, and a description whose program draws it."""
    model = onnx.load(drawing(folder / "a.onnx"))
    del model.graph.node[0]
    model.graph.input.append(helper.make_tensor_value_info("n", TensorProto.FLOAT, (1, 3)))
    onnx.save(model, folder / "a.onnx")
    (folder / "policy.yaml").write_text(
        "name: noisy\nspec:\n  inputs: [{name: x, shape: [1, 3]}]\n  outputs: [{name: y, shape: [1, 3]}]\n"
        f"  control_hz: 10\nprogram:\n  - graph: {graph}\n    feeds: {{x: x, n: noise}}\n    gives: {{y: y}}\n"
        "    noise: {noise: {shape: [1, 3], distribution: normal}}\n"
    )
    return folder / "a.onnx"


@pytest.mark.parametrize("options", [{}, {"opset": 18}])
def test_a_file_that_takes_noise_as_an_input_gets_it_from_its_program(tmp_path: Path, options: dict[str, int]) -> None:
    bundle = build(tmp_path / "out", noisy(tmp_path), policy=tmp_path, **options)
    observation = {"x": np.array([1.0, 2.0, 3.0], np.float32)}
    first, again = (load(bundle.path, threads=1, seed=7).infer(observation).chunk for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, observation["x"])
    given = load(bundle.path, threads=1).infer(observation, noise={"noise": np.ones((1, 3), np.float32)})
    np.testing.assert_allclose(given.chunk, [[2, 3, 4]])


def test_a_program_of_other_graphs_than_the_file(tmp_path: Path) -> None:
    with pytest.raises(
        SourceError, match="runs the graph 'denoise'; a policy that is one ONNX file only has the graph 'm"
    ):
        build(tmp_path / "out", noisy(tmp_path, "denoise"), policy=tmp_path)
