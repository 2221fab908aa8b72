"""What can be wrong with calibration data and with a model, and what a person is told.

One table of errors, after which nothing goes on, and one of warnings, after which the work goes on; in each row what
is done to good data or to a good graph, and a part of the sentence that must follow.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnx.parser
import pytest
from _arithmetic import full_range_or_less
from onnx import numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.spec import TensorSpec
from vlatool.cli import main
from vlatool.data._calibration_checks import _of_channels
from vlatool.errors import VlatoolError
from vlatool.quantize.bfloat16 import Bfloat16
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.sources.onnx import OnnxFile
from vlatool.stage.base import Context, Transform
from vlatool.stage.run import run_transform

Array = Any
Change = Callable[[Array], Array] | None
Asked = tuple[Transform, Bundle]


class Bench:
    """Good data and a good graph, and ways to spoil them."""

    def __init__(self, root: Path, policy: Path, bundles: dict[str, Bundle]) -> None:
        self.root, self.template, self.bundles = root, policy, bundles
        self.float = bundles["float"]

    def data(self, *, compress: bool = False, **changes: Change) -> Path:
        """The calibration data with arrays changed, dropped (None) or added."""
        with np.load(self.template / "calibration.npz") as stored:
            arrays = dict(stored)
        for name, change in changes.items():
            values = arrays.pop(name, np.zeros((24, 3), np.float32))
            if change is not None:
                arrays[name] = change(values)
        np.savez(self.root / "mine.npz", **arrays)
        return self.root / "mine.npz"

    def on(self, options: dict[str, Any] | None = None, **changes: Change) -> Asked:
        """Static int8 on changed data."""
        return StaticInt8(calibration=self.data(**changes), **(options or {})), self.float

    def file(self, content: Callable[[bytes], bytes]) -> Asked:
        path = self.data()
        path.write_bytes(content(path.read_bytes()))
        return StaticInt8(calibration=path), self.float

    def graph(self, change: Callable[[Any], Any], stage: Transform | None = None) -> Asked:
        """A stage on a bundle whose graph was changed and that was sealed again."""
        path = Path(shutil.copytree(self.float.path, self.root / "changed"))
        model = onnx.load(path / "graphs/main.onnx")
        change(model)
        onnx.save(model, path / "graphs/main.onnx")
        return stage or StaticInt8(), seal(path, self.float.manifest)

    def bytes_of_graph(self, change: Callable[[bytes], bytes], stage: Transform | None = None) -> Asked:
        path = Path(shutil.copytree(self.float.path, self.root / "changed"))
        file = path / "graphs/main.onnx"
        file.write_bytes(change(file.read_bytes()))
        return stage or StaticInt8(), seal(path, self.float.manifest)

    def without_weights(self, stage: Transform) -> Asked:
        """The weights were beside the graph, and are gone."""
        asked, bundle = self.graph(lambda model: None, stage)
        path = bundle.path / "graphs/main.onnx"
        onnx.save(onnx.load(path), path, save_as_external_data=True, location="main.onnx.data", size_threshold=0)
        path.with_name("main.onnx.data").unlink()
        return asked, seal(bundle.path, bundle.manifest)


def at(index: Any, value: float) -> Callable[[Array], Array]:
    def change(values: Array) -> Array:
        values = values.copy()
        values[index] = value
        return values

    return change


def every(count: int) -> dict[str, Change]:
    names = ("image", "proprio", "instruction", "action", "episode")
    return dict.fromkeys(names, lambda values: values[:count])


def weights(value: float, name: str = "head.weight") -> Callable[[Any], None]:
    """Put a value into a weight."""

    def change(model: Any) -> None:
        tensor = next(tensor for tensor in model.graph.initializer if tensor.name == name)
        values = numpy_helper.to_array(tensor).copy()
        values.flat[3] = value
        tensor.CopyFrom(numpy_helper.from_array(values, name))

    return change


def opset(version: int) -> Callable[[Any], None]:
    def change(model: Any) -> None:
        model.opset_import[0].version = version

    return change


def unused_weights(model: Any) -> None:
    """Every weight is computed at run time, so that no layer has one."""
    for tensor in list(model.graph.initializer):
        if tensor.data_type == onnx.TensorProto.FLOAT and len(tensor.dims) >= 2:
            model.graph.node.insert(0, onnx.helper.make_node("Neg", [f"{tensor.name}.negative"], [tensor.name]))
            tensor.name = f"{tensor.name}.negative"


class Row(NamedTuple):
    name: str
    says: str
    asked: Callable[[Bench], Asked]
    fix: str = ""


ERRORS = [
    Row("NaN in an input", r"'proprio' in .*mine.npz is not finite in 1 of 24 samples; the first is sample 5",
        lambda b: b.on(proprio=at((5, 1), np.nan)), "remove those samples"),
    Row("infinity in an input", r"'proprio' in .* is not finite in 2 of 24 samples; the first is sample 3",
        lambda b: b.on(proprio=at((slice(3, 5), 0), -np.inf))),
    Row("numbers beyond float32", r"'proprio' in .* exceeds float32 in sample 7: 1e\+60; allowed: 3.4",
        lambda b: b.on(proprio=lambda v: at((7, 0), 1e60)(v.astype(np.float64)))),
    Row("complex numbers", "'proprio' in .* is complex64; the policy takes float32",
        lambda b: b.on(proprio=lambda v: v.astype(np.complex64)), "store it as float32"),
    Row("numbers as text", "'proprio' in .* is <U32; the policy takes float32",
        lambda b: b.on(proprio=lambda v: v.astype(str))),
    Row("numbers as booleans", "'proprio' in .* is bool; the policy takes float32",
        lambda b: b.on(proprio=lambda v: v > 0)),
    Row("an input of the wrong width", r"'proprio' in .* has the shape \[24, 4\]; wanted \[N, 3\]",
        lambda b: b.on(proprio=lambda v: np.zeros((24, 4), np.float32))),
    Row("images with channels first", r"'image' in .* has the shape \[24, 3, 8, 8\]; wanted \[N, 8, 8, 3\]",
        lambda b: b.on(image=lambda v: v.transpose(0, 3, 1, 2))),
    Row("images of floats", "'image' in .* is float32; the policy takes uint8",
        lambda b: b.on(image=lambda v: (v / 255).astype(np.float32)), "store raw pixel values from 0 to 255"),
    Row("different numbers of samples", "different numbers of samples: .*'image': 9, 'proprio': 24",
        lambda b: b.on(image=lambda v: v[:9]), "each array needs one row a sample"),
    Row("no samples", "mine.npz holds no samples", lambda b: b.on(**every(0))),
    Row("a missing input", "has no 'proprio'; did you mean 'propio'",
        lambda b: b.on(proprio=None, propio=lambda v: v)),
    Row("a missing text", "has no 'instruction'; known: action, episode", lambda b: b.on(instruction=None)),
    Row("text that is numbers", "'instruction' in .* is int64; a text input needs unicode strings",
        lambda b: b.on(instruction=lambda v: np.arange(24))),
    Row("inputs whose names are swapped", r"'image' in .* has the shape \[24, 3\]; wanted \[N, 8, 8, 3\]",
        lambda b: b.on(image=lambda v: np.zeros((24, 3), np.float32), proprio=lambda v: np.zeros((24, 8, 8, 3))),
        "it would fit 'proprio'; are the names swapped"),
    Row("actions of the wrong width", "the expert's action in .* has 5 elements; the policy gives 2",
        lambda b: b.on(action=lambda v: np.zeros((24, 4, 5), np.float32))),
    Row("actions that are not finite", "the expert's action in .* is not finite in 1 of 24",
        lambda b: b.on(action=at((2, 0, 0), np.nan))),
    Row("an archive cut short", "mine.npz cannot be read", lambda b: b.file(lambda data: data[:-300]), "np.savez"),
    Row("an archive of pickled objects", "it holds pickled objects, which are refused",
        lambda b: b.on(image=lambda v: np.array([{"a": 1}] * 24))),
    Row("no archive", "none.npz not found", lambda b: (StaticInt8(calibration=b.root / "none.npz"), b.float)),
    Row("a sample that makes infinity", r"Calibration sample 5 makes the tensor '.*' of the graph 'main' not finite \(",
        lambda b: b.on({"exclude": ("state",)}, proprio=at((5, 1), 8e37)), "int8 cannot represent what float32 cannot"),
    Row("a NaN weight", r"The weight 'head.weight' of the layer 'head/Gemm' holds NaN or infinity \(1 of 128 values\)",
        lambda b: b.graph(weights(np.nan)), "keep the layer in float32 with --exclude"),
    Row("an infinite weight", "The weight 'vision.weight' of the layer 'vision/Conv' holds NaN or infinity",
        lambda b: b.graph(weights(np.inf, "vision.weight"))),
    Row("a NaN bias", "The weight 'state.bias' of the layer 'state/Gemm' holds NaN",
        lambda b: b.graph(weights(np.nan, "state.bias"))),
    Row("a NaN weight, dynamic", "The weight 'head.weight' of the layer 'head/Gemm' holds NaN",
        lambda b: b.graph(weights(np.nan), DynamicInt8())),
    Row("an opset that is too old", "The graph has opset 12; int8 needs opset 13 or later",
        lambda b: b.graph(opset(12))),
    Row("a layer whose weights are NaN, left out", "Calibration sample 0: The output 'action' is not finite",
        lambda b: b.graph(weights(np.nan), StaticInt8(exclude=("head",)))),
    Row("no layer left", "No layer is left to quantize: include, exclude and parts rule out all 8",
        lambda b: b.on({"include": ("head",), "exclude": ("head*",)}), "the first layers are vision/Conv"),
    Row("no layer left, dynamic", "No layer is left to quantize: .* rule out all 7",
        lambda b: (DynamicInt8(exclude=("*",)), b.float)),
    Row("no layer at all", "No layer of .* can be quantized by quantize.static_int8", lambda b: b.graph(unused_weights),
        "vlatool inspect"),
    Row("include matches nothing", "No node matches 'haed'; ", lambda b: b.on({"include": ("haed",)})),
    Row("an unknown part", "The policy has no part 'haed'; did you mean 'head'", lambda b: b.on({"parts": ("haed",)})),
    Row("an unknown part, dynamic", "The policy has no part 'haed'", lambda b: (DynamicInt8(parts=("haed",)), b.float)),
    Row("a graph cut short", "The graph 'main' cannot be quantized: DecodeError",
        lambda b: b.bytes_of_graph(lambda data: data[:-100])),
    Row("a graph cut short, dynamic", "The graph 'main' cannot be quantized: DecodeError",
        lambda b: b.bytes_of_graph(lambda data: data[:-100], DynamicInt8())),
    Row("weights beside the graph are gone", "The weights of .*main.onnx cannot be read: .*main.onnx.data",
        lambda b: b.without_weights(StaticInt8()), "put the file of its weights next to the graph"),
    Row("weights beside the graph are gone, bfloat16", "The weights of .*main.onnx cannot be read",
        lambda b: b.without_weights(Bfloat16())),
    Row("an int8 bundle", "The graph 'main' of .* is int8 already; quantize.static_int8 starts from float32",
        lambda b: (StaticInt8(), b.bundles["int8"]), "quantize the float32 bundle"),
    Row("dynamic int8 of an int8 bundle", "is int8 already; quantize.dynamic_int8 starts from float32",
        lambda b: (DynamicInt8(), b.bundles["int8"])),
    Row("bfloat16 of an int8 bundle", "is int8 already; quantize.bfloat16 starts from float32",
        lambda b: (Bfloat16(), b.bundles["int8"])),
]  # fmt: skip
WARNINGS = [
    Row("float64", "'proprio' in .*mine.npz is float64; the policy takes float32, so it is rounded",
        lambda b: b.on(proprio=lambda v: v.astype(np.float64))),
    Row("fewer samples than asked for", "96 calibration samples were asked for; .*mine.npz holds 24",
        lambda b: b.on({"samples": 96})),
    Row("hardly any samples", "ranges from 5 calibration samples are unreliable; use 64 or more, from every task",
        lambda b: b.on({"samples": 5})),
    Row("a recording of hardly any samples", "ranges from 3 calibration samples are unreliable",
        lambda b: b.on(**every(3))),
    Row("a channel that never changes", r"'proprio' in .* never changes over the 24 .* in channel 1 = 0.25",
        lambda b: b.on(proprio=at((slice(None), 1), 0.25))),
    Row("identical samples", "all 24 calibration samples of .*mine.npz are identical",
        lambda b: b.on(image=lambda v: v[[0] * 24], proprio=lambda v: v[[0] * 24], instruction=lambda v: v[[0] * 24])),
    Row("an array that is no input", "has the array 'propio', which is not an input of the policy and is ignored; did",
        lambda b: b.on(propio=lambda v: v)),
    Row("empty text", "the text 'instruction' in .* is empty in 2 of 24 calibration samples; the first is sample 4",
        lambda b: b.on(instruction=lambda v: np.array(["  " if i in (4, 9) else t for i, t in enumerate(v)]))),
    Row("pixels from 0 to 1", "'image' in .* looks normalised: no pixel is above 1; the policy takes raw pixel values",
        lambda b: b.on(image=lambda v: v // 128)),
    Row("black images", "'image' in .* is black in every calibration sample", lambda b: b.on(image=np.zeros_like)),
    Row("units of another size", r"'proprio' in .* is 1.2e\+04 standard deviations from the training mean in channel "
        "0 of sample 11 .above 50 in 1 of 24", lambda b: b.on(proprio=at((11, 0), 6000.0))),
]  # fmt: skip


@pytest.fixture
def bench(tmp_path: Path, policy_template: Path, float_bundle: Bundle, int8_bundle: Bundle) -> Bench:
    return Bench(tmp_path, policy_template, {"float": float_bundle, "int8": int8_bundle})


def run(asked: Asked, out: Path) -> Bundle:
    stage, bundle = asked
    return run_transform(stage, bundle, out, Context()).bundle


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("row", ERRORS, ids=lambda row: row.name.replace(" ", "-"))
def test_an_error_names_what_was_wrong_and_leaves_nothing(row: Row, bench: Bench, tmp_path: Path) -> None:
    asked = row.asked(bench)
    with pytest.raises(VlatoolError, match=row.says) as caught:
        run(asked, tmp_path / "place/out")
    assert caught.value.exit_code in (2, 3)
    assert row.fix in caught.value.fix
    assert len(caught.value.message.splitlines()) == 1
    assert list((tmp_path / "place").iterdir() if (tmp_path / "place").exists() else ()) == []


@pytest.mark.parametrize("row", WARNINGS, ids=lambda row: row.name.replace(" ", "-"))
def test_a_warning_is_said_once_and_the_work_goes_on(row: Row, bench: Bench, tmp_path: Path) -> None:
    asked = row.asked(bench)
    with pytest.warns(UserWarning, match=row.says) as caught:
        made = run(asked, tmp_path / "out")
    assert len(caught) == 1, [str(each.message) for each in caught]
    assert made.manifest.graphs["main"].precision["int8"] > 0.5
    load(made.path, threads=1)


def test_the_tables_are_complete_and_name_each_case_once() -> None:
    names = [row.name for row in (*ERRORS, *WARNINGS)]
    assert len(set(names)) == len(names) >= 45


def test_good_data_brings_no_warning(bench: Bench, tmp_path: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(bench.on(), tmp_path / "out")
    assert [str(each.message) for each in caught] == []


@pytest.mark.filterwarnings("default::UserWarning")
def test_the_command_line_shows_a_warning_once_and_as_a_sentence(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bench.data(proprio=at((slice(None), 2), 1.0))
    with pytest.raises(SystemExit) as left:
        main(["quantize", str(bench.float.path), "--calibration", str(data), "-o", str(tmp_path / "out")])
    told = capsys.readouterr().err
    assert left.value.code == 0
    lines = [line for line in told.splitlines() if line.startswith("warning: ")]
    assert lines == [
        f"warning: 'proprio' in {data} never changes over the 24 calibration samples in channel 2 = 1; "
        "what depends on it is not calibrated"
    ]
    assert "UserWarning" not in told
    assert "static_int8.py" not in told


def test_a_graph_whose_axes_are_free_is_calibrated(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    text = '<ir_version: 10, opset_import: ["" : 20]> g (float[1,points,3] cloud) => (float[1,4] action) {'
    model = onnx.parser.parse_model(text + " h = MatMul(cloud, w)  r = Relu(h)  m = ReduceMean<keepdims=0>(r, one)"
                                    "  action = MatMul(m, v) }")  # fmt: skip
    known = {"w": random.standard_normal((3, 32)), "v": random.standard_normal((32, 4))}
    model.graph.initializer.extend(numpy_helper.from_array(v.astype(np.float32), name) for name, v in known.items())
    model.graph.initializer.append(numpy_helper.from_array(np.array([1]), "one"))
    onnx.save(model, tmp_path / "cloud.onnx")
    np.savez(tmp_path / "mine.npz", cloud=random.standard_normal((64, 9, 3)).astype(np.float32))
    file = OnnxFile(model=tmp_path / "cloud.onnx", shape=("cloud=1,points,3",))
    source = run_transform(file, None, tmp_path / "float", Context()).bundle
    for layout in ("ort", "qdq", "openvino"):
        exact = full_range_or_less() if layout == "openvino" else {}
        stage = StaticInt8(calibration=tmp_path / "mine.npz", layout=layout, **exact)
        made = run_transform(stage, source, tmp_path / layout, Context()).bundle
        for points in (9, 18):
            observation = {"cloud": random.standard_normal((points, 3)).astype(np.float32)}
            got, wanted = (load(each.path, threads=1).infer(observation).chunk for each in (made, source))
            assert np.linalg.norm(got - wanted) <= 0.15 * np.linalg.norm(wanted), (layout, points, got, wanted)


def test_a_scalar_input_that_changes_from_sample_to_sample_is_no_constant_channel() -> None:
    tensor = TensorSpec("time", (1,), "float32")
    assert list(_of_channels("'time'", tensor, np.linspace(0, 1, 8, dtype=np.float32))) == []
    assert len(list(_of_channels("'time'", tensor, np.full(8, 0.5, np.float32)))) == 1
