from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.runtime import load
from vlatool.sources.onnx import OnnxFile
from vlatool.stage.base import Context

HEAD = '<ir_version: 10, opset_import: ["": 20]> '


def bundle_of(folder: Path, text: str, said: list[str] | None = None) -> Bundle:
    onnx.save(onnx.parser.parse_model(HEAD + text), folder / "a.onnx")
    (folder / "out").mkdir()
    tell = Context((lambda words, _share: said.append(words)) if said is not None else Context().progress)
    return OnnxFile(model=folder / "a.onnx").run(None, folder / "out", tell).bundle


@pytest.mark.parametrize(
    ("text", "shapes", "chunk"),
    [
        ("g (float[3,5] x, float[5] z) => (float[3,5] y) { y = Add(x, z) }", [(1, 3, 5), (1, 5), (1, 3, 5)], 3),
        ("g (float[5] x, float[1,5] z) => (float[1,5] y) { y = Add(x, z) }", [(1, 5), (1, 5), (1, 5)], 1),
        ("g (float[4] x, float[4] z) => (float[4] y) { x_observed_0 = Neg(x)  y = Add(x_observed_0, z) }",
         [(1, 4), (1, 4), (1, 4)], 1),
        ("g (float[2,5] x, float[N,5] z) => (float[M,5] y) { y = Concat<axis=0>(x, z) }",
         [(1, 2, 5), (1, 5), (1, 3, 5)], 3),
    ],
    ids=["both", "one", "a name that is taken", "beside a free axis"],
)  # fmt: skip
def test_inputs_without_a_batch_axis_get_one(tmp_path: Path, text, shapes, chunk):
    said: list[str] = []
    made = bundle_of(tmp_path, text, said)
    spec = made.manifest.spec
    assert [tensor.shape for tensor in (*spec.inputs, *spec.outputs)] == shapes
    assert spec.chunk == chunk
    assert "no batch axis: one of 1 is put in front" in " ".join(said)
    chance = np.random.default_rng(0)
    given = {tensor.name: chance.normal(size=tensor.shape[1:]).astype(np.float32) for tensor in spec.inputs}
    file = onnxruntime.InferenceSession(str(tmp_path / "a.onnx"), providers=["CPUExecutionProvider"])
    feeds = {each.name: given[each.name].reshape([axis if isinstance(axis, int) else 1 for axis in each.shape])
             for each in file.get_inputs()}  # fmt: skip
    (wanted,) = file.run(None, feeds)
    got = load(made.path, threads=1).infer(given).chunk
    np.testing.assert_allclose(got, wanted.reshape(got.shape), rtol=1e-6)


def test_such_a_file_is_converted_to_another_opset(tmp_path: Path):
    text = "g (float[3,5] x, float[5] z) => (float[3,5] y) { y = Add(x, z) }"
    onnx.save(onnx.parser.parse_model(HEAD + text), tmp_path / "a.onnx")
    (tmp_path / "out").mkdir()
    made = OnnxFile(model=tmp_path / "a.onnx", opset=18).run(None, tmp_path / "out", Context()).bundle
    assert made.manifest.graphs["main"].opset == 18


def test_a_graph_inside_reads_what_the_input_was(tmp_path: Path):
    made = bundle_of(tmp_path, """g (float[3] x) => (float[3] y) {
        s = ReduceSum<keepdims=0>(x)  zero = Constant<value=float {0.0}>()  c = Greater(s, zero)
        y = If(c) <then_branch = t () => (float[3] a) { a = Neg(x) }, else_branch = e () => (float[3] b) { b = Abs(x) }>
    }""")  # fmt: skip
    policy = load(made.path, threads=1)
    np.testing.assert_allclose(policy.infer({"x": [1, 2, 3]}).chunk, [[-1, -2, -3]])
    np.testing.assert_allclose(policy.infer({"x": [-1, -2, 3]}).chunk, [[1, 2, 3]])


def test_a_batch_axis_that_is_there_stays_as_it_is(tmp_path: Path):
    made = bundle_of(tmp_path, "g (float[1,5] x) => (float[1,5] y) { y = Neg(x) }")
    assert [node.op_type for node in onnx.load(made.file("graphs/main.onnx")).graph.node] == ["Neg"]


def test_a_description_of_a_file_without_batch_axes(tmp_path: Path) -> None:
    """What is proposed for such a file has a batch axis; read again, it is the same policy."""
    text = "g (float[2, 1, 4] state) => (float[2, 1, 4] action) { action = Relu(state) }"
    onnx.save(onnx.parser.parse_model(HEAD + text), tmp_path / "net.onnx")
    (tmp_path / "policy.yaml").write_text(
        "name: net\nspec:\n  inputs: [{name: state, shape: [1, 2, 1, 4]}]\n"
        "  outputs: [{name: action, shape: [1, 2, 1, 4]}]\n  control_hz: unknown\n  chunk: 2\n"
    )
    (tmp_path / "out").mkdir()
    source = OnnxFile(model=tmp_path / "net.onnx", policy=tmp_path / "policy.yaml")
    bundle = source.run(None, tmp_path / "out", Context()).bundle
    state = np.random.default_rng(0).normal(size=(2, 1, 4)).astype(np.float32)
    outputs = load(bundle.path, threads=1).infer({"state": state}).outputs
    np.testing.assert_array_equal(outputs["action"][0], np.maximum(state, 0))


def test_a_first_axis_with_a_name_of_its_own_is_what_a_run_shows(tmp_path: Path) -> None:
    """An output whose axes have names that no input has: they are lengths that the exporter could not tell."""
    text = """g (float[batch, 4] state) => (float[batch, 4] action, float[Concat_dim_0, Concat_dim_1] twice)
        { twice = Concat<axis = 0>(state, state) action = Identity(state) }"""
    bundle = bundle_of(tmp_path, text)
    assert [each.shape for each in bundle.manifest.spec.outputs] == [(1, 4), (2, 4)]
