"""An engine on another provider: OpenVINO inside of ONNX Runtime, from the package onnxruntime-openvino."""

from vlatool.runtime.engines import OnnxRuntimeSession


class OpenvinoProvider(OnnxRuntimeSession):
    """Opens a graph on OpenVINO's execution provider; a node that it does not take is an error."""

    title = "ONNX Runtime with OpenVINO"
    extra = ""
    substitutes = ("onnxruntime-openvino",)
    providers = (("OpenVINOExecutionProvider", {"device_type": "CPU"}),)
