"""OpenVINO's devices that this machine lacks: what is refused, with a core that claims to have them where it must.

The models are read by OpenVINO itself; only the list of devices, and what a compiled model says of itself, are made up.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

from vlatool.errors import GraphError, MissingExtra
from vlatool.machine import host
from vlatool.runtime.engine import usable_engines
from vlatool.runtime.engines import _openvino_device, openvino
from vlatool.runtime.engines._openvino_core import openvino_core
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.openvino_gpu import OpenvinoGpuSession
from vlatool.runtime.engines.openvino_npu import OpenvinoNpuSession

PRODUCT = '<ir_version: 10, opset_import: ["" : 20]> g (T[1,8] x) => (T[1,8] y) { y = MatMul(x, w) }'


def product(folder: Path, dtype: Any = np.float32, text: str = PRODUCT) -> Path:
    name = {np.float32: "float", np.float16: "float16"}[dtype]
    model = onnx.parser.parse_model(text.replace("T[", f"{name}["))
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.ones((8, 8), dtype), "w"))
    onnx.save(model, folder / "product.onnx")
    return folder / "product.onnx"


class Core:
    """OpenVINO's core, which claims to find further devices, and compiles for the processor in their place."""

    def __init__(self, *devices: str) -> None:
        self._core, self.available_devices = openvino_core(), ["CPU", *devices]
        self.asked: list[tuple[str, dict[str, Any]]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)

    def compile_model(self, model: Any, device: str, settings: dict[str, Any]) -> Any:
        self.asked.append((device, settings))
        return self._core.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Core:
    found = Core("GPU.0", "NPU")
    for module in (openvino, _openvino_device):
        monkeypatch.setattr(module, "openvino_core", lambda: found)
    return found


@pytest.mark.parametrize("engine", [OpenvinoGpuSession, OpenvinoNpuSession])
def test_a_device_that_is_not_there_is_refused_and_not_replaced(tmp_path: Path, engine: Any) -> None:
    if engine.is_installed():
        pytest.skip("this machine has the device")
    with pytest.raises(MissingExtra, match=f"finds no {engine.device} on this machine; it finds CPU") as caught:
        engine(product(tmp_path))
    assert "driver" in caught.value.fix
    with pytest.raises(MissingExtra, match=f"finds no {engine.device}"):
        engine.execution_providers()


@pytest.mark.parametrize("engine", [OpenvinoGpuSession, OpenvinoNpuSession])
def test_a_model_that_was_compiled_for_the_processor_is_refused(tmp_path: Path, core: Core, engine: Any) -> None:
    with pytest.raises(GraphError, match=f"compiled .*product.onnx for CPU; wanted {engine.device}"):
        engine(product(tmp_path, np.float16))
    ((device, settings),) = core.asked
    assert device == engine.device
    assert settings["INFERENCE_PRECISION_HINT"] == engine.hints[""]


def test_a_precision_that_the_device_does_not_keep_is_refused(tmp_path: Path, core: Core, monkeypatch: Any) -> None:
    monkeypatch.setattr(OpenvinoGpuSession, "_check_execution", lambda _: None)
    with pytest.raises(GraphError, match="in f32 on this GPU; wanted f16"):
        OpenvinoGpuSession(product(tmp_path), compute="float16")
    with pytest.raises(GraphError, match=r"on the NPU does not compute in float32; .*float16"):
        OpenvinoNpuSession(product(tmp_path), compute="float32")


def test_the_npu_refuses_products_in_float32_by_name(tmp_path: Path, core: Core) -> None:
    with pytest.raises(GraphError, match=r"the graph multiplies in float32: MatMul \(") as caught:
        OpenvinoNpuSession(product(tmp_path))
    assert "vlatool quantize float16" in caught.value.fix
    assert core.asked == []


def test_the_processor_says_that_it_ran_the_model(tmp_path: Path) -> None:
    assert OpenvinoSession(product(tmp_path), 1)._compiled.get_property("EXECUTION_DEVICES") == ["CPU"]


def test_devices_are_found_without_a_library_and_change_no_keys_where_absent(tmp_path: Path, monkeypatch: Any) -> None:
    for name, vendor in (("drm/renderD128", "0x8086\n"), ("drm/renderD129", "0x10de\n"), ("accel/accel0", "0x8086\n")):
        file = tmp_path / "sys/class" / name / "device/vendor"
        file.parent.mkdir(parents=True)
        file.write_text(vendor)
    assert host.intel_devices("drm/renderD*", tmp_path) == ["renderD128"]
    assert host.intel_devices("accel/accel*", tmp_path) == ["accel0"]
    assert host.intel_devices("accel/accel*", tmp_path / "none") == []
    assert OpenvinoNpuSession.identity().startswith("NPU ")
    layouts = [name for name, library in usable_engines().items() if "openvino" in library.layouts]
    assert layouts == ["openvino"]
    assert OpenvinoNpuSession.variants(None, True) == {}
