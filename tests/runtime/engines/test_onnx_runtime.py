"""Engines on ONNX Runtime: providers and options as data, where tensors live, what they are built against."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnxruntime
import pytest

from vlatool.errors import GraphError, MissingExtra
from vlatool.machine import host
from vlatool.runtime.engines import OnnxRuntimeSession, _bound_buffers, _onnx_runtime
from vlatool.runtime.engines._bound_buffers import DeviceBuffers
from vlatool.runtime.engines._reference import ReferenceSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession

SUM = """<ir_version: 10, opset_import: ["" : 20]>
g (float[1,3] x, int64[2] n) => (float[1,3] y, int64[2] m) { y = Add(x, x)  m = Add(n, n) }"""
CPU = ("CPUExecutionProvider", {"use_arena": "0"})


def engine(*providers: tuple[str, dict[str, Any]], **facts: Any) -> type[OnnxRuntimeSession]:
    return type("Session", (OnnxRuntimeSession,), {"providers": providers, **facts})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    onnx.save(onnx.parser.parse_model(SUM), str(tmp_path / "sum.onnx"))
    return tmp_path / "sum.onnx"


def feeds(value: float) -> dict[str, np.ndarray]:
    return {"x": np.full((1, 3), value, np.float32), "n": np.array([1, int(value)], np.int64)}


def test_providers_reach_the_session_in_order_with_their_options(path: Path, monkeypatch) -> None:
    asked: list[Any] = []
    real = onnxruntime.InferenceSession

    def opened(*given: Any, **named: Any) -> Any:
        asked.append(named["providers"])
        return real(*given, **named)

    monkeypatch.setattr(onnxruntime, "InferenceSession", opened)
    session = engine(("AzureExecutionProvider", {}), CPU)(path, 1)
    assert session._session.get_providers() == ["AzureExecutionProvider", "CPUExecutionProvider"]
    assert asked == [[("AzureExecutionProvider", {}), CPU]]
    np.testing.assert_array_equal(session.run(feeds(2))["y"], np.full((1, 3), 4, np.float32))


def test_a_node_that_no_named_provider_runs_is_an_error(path: Path) -> None:
    with pytest.raises(GraphError, match=r"refuses .*sum.onnx: AzureExecutionProvider does not run Add, Add") as caught:
        engine(("AzureExecutionProvider", {}))(path, 1)
    assert caught.value.fix == "AzureExecutionProvider does not run every node of it: use another engine"


def test_a_provider_that_is_not_there_is_named_with_what_installs_it(path: Path) -> None:
    absent = engine(("CUDAExecutionProvider", {}), CPU, extra="", substitutes=("onnxruntime-gpu",))
    for use in (lambda: absent(path, 1), absent.execution_providers):
        with pytest.raises(MissingExtra, match=r"has no CUDAExecutionProvider on this machine; it has .*CPU") as caught:
            use()
        assert caught.value.fix == "pip install onnxruntime-gpu"
    assert not absent.is_installed()
    assert OrtCpuSession.is_installed()


def test_nodes_that_a_provider_does_not_run_are_named_a_few_of_many(tmp_path: Path) -> None:
    nodes = "".join(f"[n{index}] v{index + 1} = Relu(v{index}) " for index in range(5))
    text = f'<ir_version: 10, opset_import: ["" : 20]> g (float[2] v0) => (float[2] v5) {{ {nodes} }}'
    onnx.save(onnx.parser.parse_model(text), str(tmp_path / "many.onnx"))
    with pytest.raises(GraphError, match=r"does not run Relu \(n0\), Relu \(n1\), Relu \(n2\), 2 more"):
        engine(("AzureExecutionProvider", {}))(tmp_path / "many.onnx", 1)


def test_a_provider_that_is_not_loaded_is_the_reason_and_no_node(path: Path, monkeypatch) -> None:
    """The same error of ONNX Runtime has two causes: here the library of the provider lacks one that it needs."""
    monkeypatch.setattr(onnxruntime.InferenceSession, "get_providers", lambda _: ["CPUExecutionProvider"])
    missing = engine(("AzureExecutionProvider", {}))
    with pytest.raises(GraphError, match=r"it cannot load AzureExecutionProvider on this machine") as caught:
        missing(path, 1)
    assert caught.value.fix == "install the driver and the libraries that AzureExecutionProvider needs"
    with pytest.raises(MissingExtra, match="cannot load AzureExecutionProvider"):
        missing.execution_providers()


def test_a_plug_in_that_cannot_be_loaded_is_named(path: Path, tmp_path: Path) -> None:
    library = tmp_path / "libacme.so"
    library.write_bytes(b"not a library")
    broken = engine(("Acme", {}), extra="", provider_library=classmethod(lambda _: library))
    with pytest.raises(MissingExtra, match=r"has no Acme .*libacme.so cannot be loaded: "):
        broken(path, 1)


def test_a_provider_that_the_session_left_out_is_refused(path: Path, monkeypatch) -> None:
    """ONNX Runtime goes on without a provider whose libraries it cannot load."""
    monkeypatch.setattr(onnxruntime.InferenceSession, "get_providers", lambda _: ["CPUExecutionProvider"])
    with pytest.raises(GraphError, match=r"opened on CPU.*; wanted Azure.*, CPU") as caught:
        engine(("AzureExecutionProvider", {}), CPU)(path, 1)
    assert "driver and the libraries that AzureExecutionProvider needs" in caught.value.fix


def test_a_dtype_that_it_does_not_compute_in_is_refused(path: Path) -> None:
    with pytest.raises(GraphError, match=r"on AzureExecutionProvider, CPU.* does not compute in bfloat16"):
        engine(("AzureExecutionProvider", {}), CPU)(path, 1, "bfloat16")


def test_buffers_of_a_device_give_the_same_and_results_do_not_change_later(path: Path) -> None:
    """On a processor the device is its own memory: the copies are real, the graphics card is not."""
    session = OrtCpuSession(path, 1)
    session._bound = DeviceBuffers.of(session._session, onnxruntime, "cpu")
    assert isinstance(session._bound, DeviceBuffers)
    first, second = session.run(feeds(2)), session.run(feeds(5))
    np.testing.assert_array_equal(first["y"], np.full((1, 3), 4, np.float32))
    np.testing.assert_array_equal(second["y"], np.full((1, 3), 10, np.float32))
    np.testing.assert_array_equal(first["m"], [2, 4])
    with pytest.raises(GraphError, match="double"):
        session.run({**feeds(1), "x": np.zeros((1, 3))})


def test_a_class_chooses_the_memory_of_its_device(path: Path, monkeypatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(_bound_buffers, "DeviceBuffers", lambda *given: asked.append(given[-1]))
    engine(CPU, memory="cuda")(path, 1)
    assert asked == ["cuda"]


def test_what_it_is_built_against_names_providers_versions_cards_and_driver(monkeypatch) -> None:
    monkeypatch.setattr(_onnx_runtime, "gpus", lambda: ("NVIDIA A10",))
    monkeypatch.setattr(_onnx_runtime, "gpu_driver", lambda: "NVIDIA driver 550.54.15")
    found = engine(("TensorrtExecutionProvider", {"trt_fp16_enable": True})).identity()
    assert found == (
        f"TensorrtExecutionProvider {json.dumps({'trt_fp16_enable': True})}; "
        f"onnxruntime {host.versions()['onnxruntime']}; NVIDIA A10; NVIDIA driver 550.54.15"
    )
    assert (OrtCpuSession.identity(), ReferenceSession.identity()) == ("", "")
