"""OpenVINO on Intel's graphics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from vlatool.runtime.engines._openvino_device import OpenvinoDevice


class OpenvinoGpuSession(OpenvinoDevice):
    """One ONNX file compiled by OpenVINO for Intel's graphics, in float32 unless asked for float16."""

    title = "OpenVINO on Intel's graphics"
    device = "GPU"
    kernel_name = "drm/renderD*"
    driver = "install Intel's driver: apt install intel-opencl-icd"
    advice = "Intel's graphics; needs the driver intel-opencl-icd"
    computes = ("float32", "float16")
    hints: ClassVar[Mapping[str, str]] = {"": "f32", "float32": "f32", "float16": "f16"}
