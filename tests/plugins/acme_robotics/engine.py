"""An engine: ONNX Runtime under another name."""

from vlatool.runtime.engines.ort_cpu import OrtCpuSession


class AcmeSession(OrtCpuSession):
    """Opens a graph."""

    title = "Acme Engine"
    package = "acme_robotics"
    substitutes = ("acme-robotics",)
    layouts = {}

    @classmethod
    def execution_providers(cls):
        """Run on one thing alone."""
        return ["AcmeExecutionProvider"]

    @classmethod
    def variants(cls, has, calibrated):
        """Try what it is good at."""
        return {"acme_float16": ({"quantize.float16": {}},)}
