"""Statistics of activations while samples stream by: what offline runs give, in memory that does not grow."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnxruntime
import pytest
from _arithmetic import full_range_or_less
from onnx import numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import recorded_observations
from vlatool.errors import DataError, GraphError
from vlatool.quantize.calibration.activation_statistics import calibrate
from vlatool.quantize.calibration.ranges import Statistics
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.runtime.observation import ObservationEncoder
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

WIDTH = 64
LOOP = """(float[1,W] x, float[1,W] h, float[1] t) => (float[1,W] g)
    { a = MatMul(x, w)  b = MatMul(h, w)  c = Add(a, b)  d = Add(c, t)  g = Tanh(d) }"""
HEAD = "(float[1,W] g) => (float[1,2] y) { r = Relu(g)  y = MatMul(r, v) }"


def model(text: str, **weights: Any) -> Any:
    made = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> g {text.replace("W", str(WIDTH))}')
    made.graph.initializer.extend(numpy_helper.from_array(values, name) for name, values in weights.items())
    return made


def looping(folder: Path) -> Bundle:
    """A policy of two graphs; the first runs three times on noise, a schedule and what it gave before."""
    random = np.random.default_rng(0)
    (folder / "graphs").mkdir(parents=True)
    w, v = (random.standard_normal((WIDTH, size)).astype(np.float32) / 8 for size in (WIDTH, 2))
    onnx.save(model(LOOP, w=w), folder / "graphs/loop.onnx")
    onnx.save(model(HEAD, v=v), folder / "graphs/head.onnx")
    spec = PolicySpec((TensorSpec("x", (1, WIDTH)),), (TensorSpec("y", (1, 2)),), 10.0)
    program = (
        ProgramStep(
            "loop", {"x": "x", "h": "state", "t": "time"}, {"g": "new"}, repeat=3, carry={"new": "state"},
            schedule={"time": [1.0, 0.5, 0.25]}, noise={"state": {"shape": [1, WIDTH]}},
        ),
        ProgramStep("head", {"g": "new"}, {"y": "y"}),
    )  # fmt: skip
    graphs = {name: Graph(f"graphs/{name}.onnx", {"float32": 1.0}, 20) for name in ("loop", "head")}
    files = {graph.file: FileRecord("", 0) for graph in graphs.values()}
    return seal(folder, Manifest("looping", "1", spec, graphs, program, files))


def drawn(count: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    random = np.random.default_rng(seed)
    for _ in range(count):
        yield {"x": random.standard_normal(WIDTH).astype(np.float32)}


def same(got: Statistics, values: list[Any]) -> None:
    wanted = Statistics()
    for value in values:
        wanted.add(np.asarray(value))
    assert (got.low, got.high, got.samples) == pytest.approx((wanted.low, wanted.high, wanted.samples), rel=1e-5)
    assert int(np.abs(got.counts - wanted.counts).sum()) <= 0.001 * wanted.counts.sum()


def with_all_outputs(path: Path) -> onnxruntime.InferenceSession:
    whole = onnx.shape_inference.infer_shapes(onnx.load(path))
    known = {value.name for value in whole.graph.output}
    for node in whole.graph.node:
        whole.graph.output.extend(onnx.ValueInfoProto(name=name) for name in node.output if name not in known)
    return onnxruntime.InferenceSession(whole.SerializeToString(), providers=["CPUExecutionProvider"])


def test_streamed_statistics_equal_those_of_recorded_activations(float_bundle: Bundle) -> None:
    session = with_all_outputs(float_bundle.path / "graphs/main.onnx")
    observations = recorded_observations(float_bundle, 10)
    encode = ObservationEncoder(float_bundle.manifest.spec, float_bundle.path / "assets")
    names = [value.name for value in session.get_outputs()]
    runs = [dict(zip(names, session.run(names, encode(each)), strict=True)) for each in observations]
    floats = [name for name in names if runs[0][name].dtype == np.float32]
    found = calibrate(float_bundle, {"main": [*floats, "proprio"]}, observations, Context())
    assert len(floats) > 20
    for name in floats:
        same(found["main"][name], [run[name] for run in runs])
    same(found["main"]["proprio"], [encode(each)["proprio"] for each in observations])


def test_every_turn_of_a_loop_is_seen(tmp_path: Path) -> None:
    bundle = looping(tmp_path / "bundle")
    wanted = {"loop": ["x", "h", "c", "g"], "head": ["g", "r"]}
    found = calibrate(bundle, wanted, drawn(5), Context(), channels=True)
    assert {name: each.samples for name, each in found["loop"].items()} == {"x": 15, "h": 15, "c": 15, "g": 15}
    assert {name: each.samples for name, each in found["head"].items()} == {"g": 5, "r": 5}
    weights = numpy_helper.to_array(onnx.load(tmp_path / "bundle/graphs/loop.onnx").graph.initializer[0])
    noise = np.random.default_rng(0)
    seen: dict[str, list[Any]] = {"h": [], "c": [], "g": []}
    for each in drawn(5):
        state = noise.standard_normal((1, WIDTH), np.float32)
        for time in (1.0, 0.5, 0.25):
            both = each["x"] @ weights + state @ weights
            seen["h"].append(state)
            seen["c"].append(both)
            state = np.tanh(both + np.float32(time))
            seen["g"].append(state)
    for name, values in seen.items():
        same(found["loop"][name], values)
        peaks = found["loop"][name].peaks
        assert peaks is not None
        np.testing.assert_allclose(peaks, np.abs(np.concatenate(values)).max(0), rtol=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_activation_that_is_not_finite_names_sample_graph_and_tensor(tmp_path: Path, value: float) -> None:
    bundle = looping(tmp_path / "bundle")
    text = HEAD.replace("r = Relu(g)", "k = Exp(g)  r = Mul(k, big)")
    big = np.full(1, 3e38 if np.isinf(value) else np.nan, np.float32)
    onnx.save(model(text, v=np.ones((WIDTH, 2), np.float32), big=big), tmp_path / "bundle/graphs/head.onnx")
    bundle = seal(bundle.path, bundle.manifest)
    with pytest.raises(DataError, match=r"Calibration sample 0 makes the tensor 'r' of the graph 'head' not finite \("):
        calibrate(bundle, {"head": ["r"]}, drawn(2), Context())


@pytest.mark.parametrize("layout", ["ort", "qdq", "openvino"])
def test_a_sum_that_is_infinite_stays_float(tmp_path: Path, layout: str) -> None:
    """A mask of -infinity is added to values that no softmax reads."""
    bundle = looping(tmp_path / "bundle")
    text = HEAD.replace("r = Relu(g)", "i = Log(seen)  k = Add(g, g)  l = Add(g, i)  m = Max(k, l)  r = Relu(m)")
    text = text.replace("float[1,W] g)", "float[1,W] g, float[1,1] seen)")
    onnx.save(model(text, v=np.ones((WIDTH, 2), np.float32)), tmp_path / "bundle/graphs/head.onnx")
    loop, head = bundle.manifest.program
    spec = replace(bundle.manifest.spec, inputs=(*bundle.manifest.spec.inputs, TensorSpec("seen", (1, 1))))
    program = (loop, replace(head, feeds={**head.feeds, "seen": "seen"}))
    bundle = seal(bundle.path, replace(bundle.manifest, program=program, spec=spec))
    x = np.random.default_rng(0).standard_normal((12, WIDTH)).astype(np.float32)
    np.savez(tmp_path / "mine.npz", x=x, seen=np.arange(12, dtype=np.float32).reshape(12, 1) % 2)
    exact = full_range_or_less() if layout == "openvino" else {}
    stage = StaticInt8(elementwise=True, calibration=tmp_path / "mine.npz", layout=layout, **exact)
    made = run_transform(stage, bundle, tmp_path / "int8", Context()).bundle
    shares = made.manifest.graphs["head"].precision
    assert shares["int8"] > 0
    observation = {"x": x[0], "seen": np.zeros(1, np.float32)}
    got = [load(path, seed=0).infer(observation).chunk for path in (bundle.path, made.path)]
    np.testing.assert_allclose(got[1], got[0], rtol=0.1)


def test_the_sample_is_called_what_the_recording_calls_it(tmp_path: Path) -> None:
    bundle = looping(tmp_path / "bundle")
    observations = list(drawn(4))
    observations[2]["x"] = np.full(WIDTH, 1e30, np.float32)
    observations[3]["x"] = np.zeros(3, np.float32)
    told: list[tuple[str, float | None]] = []
    with pytest.raises(DataError, match=r"Calibration sample 41: The input 'x' has the shape \[1, 3\]"):
        calibrate(
            bundle, {"loop": ["c"]}, observations, Context(lambda *said: told.append(said)), numbers=[3, 9, 27, 41]
        )
    assert told == [("calibrating on sample 3", 0.0)]
    observations[2]["x"] = np.full(WIDTH, 3e38, np.float32)
    with pytest.raises(DataError, match="Calibration sample 27 makes the tensor 'c' of the graph 'loop' not finite"):
        calibrate(bundle, {"loop": ["c"]}, observations[:3], Context(), numbers=[3, 9, 27])


def test_a_graph_that_never_runs_has_no_ranges(tmp_path: Path) -> None:
    bundle = looping(tmp_path / "bundle")
    graphs = {**bundle.manifest.graphs, "idle": Graph("graphs/head.onnx", {}, 20)}
    bundle = seal(bundle.path, replace(bundle.manifest, graphs=graphs))
    with pytest.raises(GraphError, match="The graph 'idle' was never run on calibration data, so 'r' has no range"):
        calibrate(bundle, {"idle": ["r"]}, drawn(2), Context())


def test_weights_beside_the_graph_are_found(tmp_path: Path) -> None:
    bundle = looping(tmp_path / "bundle")
    before = calibrate(bundle, {"loop": ["c"]}, drawn(3), Context())
    path = bundle.path / "graphs/loop.onnx"
    loaded = onnx.load(path)
    onnx.save(loaded, path, save_as_external_data=True, location="loop.onnx.data", size_threshold=0)
    after = calibrate(seal(bundle.path, bundle.manifest), {"loop": ["c"]}, drawn(3), Context())
    np.testing.assert_array_equal(before["loop"]["c"].counts, after["loop"]["c"].counts)


CHILD = """
import sys
from pathlib import Path
sys.path[:0] = {tests!r}
import test_activation_statistics as tests
from vlatool.bundle.bundle import Bundle
def peak():
    return int(next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line).split()[1])
bundle = Bundle.open({bundle!r})
wanted = {{"loop": ["x", "h", "a", "b", "c", "d", "g"], "head": ["r"]}}
def run(count):
    tests.calibrate(bundle, wanted, tests.drawn(count), tests.Context())
    return peak()
run(20)
print(run(50), run(2000))
"""


@pytest.mark.soak("the statistics of batches in this file")
def test_memory_does_not_grow_with_the_samples(tmp_path: Path) -> None:
    """2000 samples of 22 recorded tensors would be 11 MB when they were kept."""
    looping(tmp_path / "bundle")
    code = CHILD.format(tests=sys.path, bundle=str(tmp_path / "bundle"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    few, many = (int(part) for part in done.stdout.split())
    assert many - few < 2500, "kB of peak memory"
