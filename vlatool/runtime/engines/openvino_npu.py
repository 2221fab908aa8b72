"""OpenVINO on Intel's NPU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from vlatool.errors import GraphError
from vlatool.runtime.engines._openvino_device import OpenvinoDevice

PRODUCTS = ("MatMul", "Convolution", "GroupConvolution", "ConvolutionBackpropData")


class OpenvinoNpuSession(OpenvinoDevice):
    """One ONNX file compiled by OpenVINO for Intel's NPU, which computes in float16 what is not quantized.

    A graph that multiplies in float32, and quantizes nothing, is refused: the NPU would compute it in float16 without a
    word.
    """

    title = "OpenVINO on Intel's NPU"
    device = "NPU"
    kernel_name = "accel/accel*"
    driver = "install Intel's driver, linux-npu-driver"
    advice = "the NPU of Intel's Core Ultra; needs linux-npu-driver and Linux 6.6"
    computes: ClassVar[tuple[str, ...]] = ("float16",)
    hints: ClassVar[Mapping[str, str]] = {"": "f16", "float16": "f16"}

    def _check_model(self, model: Any) -> None:
        operators = list(model.get_ops())
        if any(node.get_type_name() == "FakeQuantize" for node in operators):
            return
        for node in operators:
            if node.get_type_name() in PRODUCTS and node.get_output_element_type(0).get_type_name() == "f32":
                raise GraphError(
                    f"OpenVINO on the NPU computes in float16; the graph multiplies in float32: "
                    f"{node.get_type_name()} ({node.get_friendly_name()}).",
                    "make a float16 bundle (vlatool quantize float16), or use another engine",
                )
