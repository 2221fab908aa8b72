"""An engine on a provider that is a plug-in: ggml, from the package onnxruntime-ggml beside onnxruntime."""

from pathlib import Path

from vlatool.runtime.engines import OnnxRuntimeSession


class GgmlProvider(OnnxRuntimeSession):
    """Opens a graph on ggml's execution provider, where that runs every node."""

    title = "ONNX Runtime with ggml"
    package = "onnxruntime_ggml"
    extra = ""
    substitutes = ("onnxruntime-ggml",)
    providers = (("ggml", {"device": "cpu", "threads": 1}),)

    @classmethod
    def provider_library(cls):
        """Return the file that ONNX Runtime loads the provider from."""
        return Path(cls.library().library_path())
