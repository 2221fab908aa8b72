"""An engine: ONNX Runtime with another execution provider before the processor's."""

from vlatool.runtime.engines import OnnxRuntimeSession


class AcmeSession(OnnxRuntimeSession):
    """Opens a graph on a provider that every wheel of ONNX Runtime has, and that leaves all nodes to the processor."""

    title = "Acme Engine"
    package = "acme_robotics"
    extra = ""
    substitutes = ("acme-robotics",)
    providers = (("AzureExecutionProvider", {}), ("CPUExecutionProvider", {}))

    @classmethod
    def variants(cls, target, calibrated):
        """Try what it is good at: float16 on any processor, and whole graphs in int8 on Acme's own chip."""
        on_chip = {"acme_int8": ({"quantize.static_int8": {"attention": True}},)} if "Acme A1" in target.devices else {}
        return {"acme_float16": ({"quantize.float16": {}},), **on_chip}
