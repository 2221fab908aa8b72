"""The OpenVINO engine: what ONNX Runtime gives, in the precision that was asked for, with mistakes named."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

from vlatool.bundle.bundle import Bundle, seal
from vlatool.data import recorded_observations
from vlatool.errors import GraphError, MissingExtra
from vlatool.runtime import load
from vlatool.runtime.contract import Port
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.policy import Policy, relative_error

SUM = "g (float[1,3] x, int64[2] n) => (float[1,3] y, int64[2] m) { y = Add(x, x)  m = Add(n, n) }"


def graph(path: Path, text: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}'), str(path))
    return path


@pytest.fixture
def session(tmp_path: Path) -> OpenvinoSession:
    return OpenvinoSession(graph(tmp_path / "sum.onnx", SUM), threads=1)


def feeds(value: float) -> dict[str, Any]:
    return {"x": np.full((1, 3), value, np.float32), "n": np.array([1, int(value)], np.int64)}


def test_outputs_are_named_and_do_not_change_later(session: OpenvinoSession) -> None:
    first, second = session.run(feeds(2)), session.run(feeds(5))
    np.testing.assert_array_equal(first["y"], np.full((1, 3), 4, np.float32))
    np.testing.assert_array_equal(second["y"], np.full((1, 3), 10, np.float32))
    np.testing.assert_array_equal(first["m"], [2, 4])
    assert session.outputs == ["y", "m"]
    assert session.takes == {"x": Port((1, 3), "float32"), "n": Port((2,), "int64")}


ALIASED = """g (float[1,4] z, float[1,4] x) => (float[1,4] y, float[1,4] again) <int64[2] s = {1, 4}>
{ a = Reshape(z, s)  b = Identity(x)  c = Sub(a, b)  d = Relu(c)  y = Reshape(d, s)  e = Tanh(c)
again = Identity(e) }"""


@pytest.mark.parametrize("shape", ["[1,4]", "[n,4]"])
def test_ports_have_the_names_of_the_file_where_a_reshape_beside_them_is_removed(tmp_path: Path, shape: str) -> None:
    path = graph(tmp_path / "aliased.onnx", ALIASED.replace("[1,4]", shape))
    session = OpenvinoSession(path, threads=1)
    assert list(session.takes) == ["z", "x"]
    assert (session.outputs, list(session.gives)) == (["y", "again"], ["y", "again"])
    fed = {name: np.full((1, 4), value, np.float32) for name, value in (("z", 3), ("x", 2))}
    for deadline in (None, time.monotonic() + 60):
        session.deadline = deadline
        np.testing.assert_array_equal(session.run(fed)["y"], np.ones((1, 4)))
    with pytest.raises(GraphError, match="the input 'x' is missing"):
        session.run({"z": fed["z"]})


MISH = """g (float[1,4] x) => (float[1,4] y) <float[4,4] w = {1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1}>
{ a = MatMul(x, w)  b = Mish(a)  y = MatMul(b, w) }"""


def test_mish_between_two_linear_layers_is_computed(tmp_path: Path) -> None:
    """The step encoder of a Diffusion policy; OpenVINO 2026.4 alone refuses it."""
    path = graph(tmp_path / "mish.onnx", MISH)
    fed = {"x": np.array([[-2.0, -0.5, 0.0, 3.0]], np.float32)}
    wanted = fed["x"] * np.tanh(np.log1p(np.exp(fed["x"])))
    np.testing.assert_allclose(OpenvinoSession(path, threads=1).run(fed)["y"], wanted, atol=1e-5)


def test_feeds_may_be_strided(session: OpenvinoSession) -> None:
    strided = np.arange(6, dtype=np.float32).reshape(1, 6)[:, ::2]
    np.testing.assert_array_equal(session.run({**feeds(0), "x": strided})["y"], [[0, 4, 8]])


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("x", np.zeros((3,), np.float32), r"'x' is float32 \[3\]; wanted float32 \[1, 3\]"),
        ("x", np.zeros((1, 1), np.float32), r"'x' is float32 \[1, 1\]; wanted float32 \[1, 3\]"),
        ("x", np.zeros((1, 3), np.float64), "the input 'x' is float64; wanted float32"),
        ("n", np.zeros(2, np.int32), "the input 'n' is int32; wanted int64"),
        ("x", None, "the input 'x' is missing; wanted float32"),
        ("x", [[1.0, 2.0, 3.0]], "the input 'x' is list; wanted float32"),
        ("extra", np.zeros(1, np.float32), "extra"),
    ],
    ids=["rank", "width", "float64", "int32", "none", "list", "extra"],
)
def test_a_feed_that_does_not_fit_is_named(session: OpenvinoSession, name: str, value: Any, says: str) -> None:
    with pytest.raises(GraphError, match=f"OpenVINO failed in sum.onnx: .*{says}"):
        session.run({**feeds(1), name: value})
    np.testing.assert_array_equal(session.run(feeds(1))["y"], [[2, 2, 2]])


def test_a_missing_feed_is_not_taken_from_the_run_before(session: OpenvinoSession) -> None:
    session.run(feeds(3))
    with pytest.raises(GraphError, match="the input 'n' is missing; wanted int64"):
        session.run({"x": np.zeros((1, 3), np.float32)})


def test_free_axes_may_change_from_run_to_run(tmp_path: Path) -> None:
    path = graph(tmp_path / "free.onnx", "g (float[B,3] x) => (float[B,3] y) { y = Add(x, x) }")
    session = OpenvinoSession(path, threads=1)
    for rows in (1, 4, 2):
        assert session.run({"x": np.ones((rows, 3), np.float32)})["y"].shape == (rows, 3)
    with pytest.raises(GraphError, match="'x' is missing"):
        session.run({})


def test_types_that_numpy_lacks_do_not_stop_the_graph(tmp_path: Path) -> None:
    path = graph(tmp_path / "half.onnx", "g (bfloat16[1,3] x) => (float[1,3] y) { y = Cast<to = 1>(x) }")
    assert str(OpenvinoSession(path, threads=1).takes["x"]) == "bf16 [1, 3]"


@pytest.mark.parametrize("compute", ["", "float32"])
def test_the_precision_is_float32_unless_told(tmp_path: Path, compute: str) -> None:
    """Left alone, OpenVINO multiplies in bfloat16 where the processor has it: three digits instead of seven."""
    w = np.random.default_rng(0).standard_normal((256, 256)).astype(np.float32)
    model = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["" : 20]> g (float[8,256] x) => (float[8,256] y) { y = MatMul(x, w) }'
    )
    model.graph.initializer.append(onnx.numpy_helper.from_array(w, "w"))
    onnx.save(model, tmp_path / "product.onnx")
    x = np.random.default_rng(1).standard_normal((8, 256)).astype(np.float32)
    session = OpenvinoSession(tmp_path / "product.onnx", 1, compute)
    assert session.precision == "f32"
    assert relative_error(session.run({"x": x})["y"], x.astype(np.float64) @ w) < 1e-6


def test_an_unknown_precision_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="does not compute in float16; did you mean 'bfloat16'"):
        OpenvinoSession(graph(tmp_path / "sum.onnx", SUM), 1, "float16")


def test_the_policy_gives_what_it_gives_in_onnxruntime(float_bundle: Bundle) -> None:
    here, there = (Policy.open(float_bundle, engine=name, threads=1, seed=0) for name in ("openvino", "ort_cpu"))
    assert here.engine == "openvino"
    for observation in recorded_observations(float_bundle, 6):
        got, wanted = here.infer(observation).chunk, there.infer(observation).chunk
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-6)
    path = float_bundle.path / "graphs/main.onnx"
    assert OpenvinoSession(path, 1).outputs == OrtCpuSession(path, 1).outputs


def test_load_takes_the_engine_that_the_bundle_was_made_for(float_bundle: Bundle, copied: Any) -> None:
    from dataclasses import replace

    assert load(float_bundle.path, threads=1).engine == "ort_cpu"
    bundle = copied(float_bundle)
    seal(bundle.path, replace(bundle.manifest, engine="openvino"))
    assert load(bundle.path, threads=1).engine == "openvino"
    assert load(bundle.path, threads=1, engine="ort_cpu").engine == "ort_cpu"


def test_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = graph(tmp_path / "sum.onnx", SUM)
    monkeypatch.setitem(sys.modules, "openvino", None)
    for call in (OpenvinoSession.version, lambda: OpenvinoSession(path)):
        with pytest.raises(MissingExtra, match="the package 'openvino', which the extra 'openvino' provides") as caught:
            call()
        assert caught.value.fix == "pip install 'vlatool[openvino]'"


def test_the_version_is_a_release_number() -> None:
    assert OpenvinoSession.version().count(".") == 2
    assert "-" not in OpenvinoSession.version()


def test_a_file_that_is_no_graph_is_refused(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "bad.onnx"
    path.write_bytes(b"not a model")
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", "AVX2")
    with pytest.raises(GraphError, match=r"OpenVINO .* refuses .*bad.onnx: ") as caught:
        OpenvinoSession(path)
    assert len(caught.value.message.splitlines()) == 1
    assert "ONEDNN_MAX_CPU_ISA" not in caught.value.fix, "what confines OpenVINO has nothing to do with it"


BLOCKED = """g (float[1,8] x) => (float[1,4] y) <int8[8,4] w = {1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,
1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1},
float[1,4] s = {1.0,1.0,1.0,1.0}> { d = DequantizeLinear<axis = 0, block_size = 32>(w, s)  y = MatMul(x, d) }"""


def test_a_layer_that_is_narrower_than_a_block_is_told_with_its_reason(tmp_path: Path) -> None:
    path = tmp_path / "blocked.onnx"
    onnx.save(onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 21]> {BLOCKED}'), str(path))
    with pytest.raises(GraphError, match=r"\(8\) cannot be divided by block_size \(32\)") as caught:
        OpenvinoSession(path, threads=1)
    assert "ort_cpu" in caught.value.fix


@pytest.mark.parametrize("as_bytes", [False, True])
def test_a_float8_graph_that_is_refused_goes_to_another_engine(tmp_path: Path, as_bytes: bool) -> None:
    model = onnx.load(graph(tmp_path / "own.onnx", "g (float[1,3] x) => (float[1,3] y) { y = Own(x, w) }"))
    model.graph.initializer.append(onnx.helper.make_tensor("w", onnx.TensorProto.FLOAT8E4M3FN, [3], bytes(3), raw=True))
    onnx.save(model, tmp_path / "own.onnx")
    with pytest.raises(GraphError, match=r"OpenVINO .* refuses .*own.onnx") as caught:
        OpenvinoSession(tmp_path / "own.onnx", opened=(tmp_path / "own.onnx").read_bytes() if as_bytes else None)
    assert "use the engine ort_cpu" in caught.value.fix


@pytest.mark.parametrize(
    ("confined", "says"), [("SSE41", "^ONEDNN_MAX_CPU_ISA confines .* SSE41"), (None, "^this proc")]
)
def test_where_openvino_has_no_kernel_the_error_says_what_to_do(tmp_path: Path, monkeypatch, confined, says):
    class Refusing:
        def read_model(self, *_):
            raise RuntimeError("bad combination")

    monkeypatch.setattr("vlatool.runtime.engines.openvino.openvino_core", Refusing)
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    if confined:
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", confined)
    with pytest.raises(GraphError, match="bad combination") as caught:
        OpenvinoSession(tmp_path / "any.onnx")
    assert re.search(says, caught.value.fix)
    assert "--layout ort" in caught.value.fix, "the variable may stand for a board, so that unsetting it is no remedy"


SIGNALLED = """\
import gc, signal, sys, threading
from pathlib import Path
from vlatool.runtime.engines.openvino import OpenvinoSession

sessions = [OpenvinoSession(Path(sys.argv[1]), 1)]
given_up = threading.Thread(target=lambda: (sessions.clear(), gc.collect()))
given_up.start()
given_up.join()
signal.signal(signal.SIGUSR1, lambda *_: print("handled"))
signal.raise_signal(signal.SIGUSR1)
"""


def test_a_signal_is_handled_after_another_thread_has_given_up_the_last_session(tmp_path: Path):
    model = graph(tmp_path / "m.onnx", SUM)
    done = subprocess.run([sys.executable, "-c", SIGNALLED, model], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "handled\n"), done.stderr
