"""ONNX Runtime on a graphics card of NVIDIA, through its CUDA provider."""

from __future__ import annotations

import contextlib
import io
from typing import Any, ClassVar

from vlatool.runtime.engines._onnx_runtime import OnnxRuntimeSession, Providers


class OrtCudaSession(OnnxRuntimeSession):
    """One ONNX file open in ONNX Runtime on the first graphics card that CUDA shows to this process.

    Products of float32 are computed in float32: TF32, which ONNX Runtime (1.31) takes on Ampere and later if left
    alone, keeps 10 bits of each factor. cuDNN chooses the algorithm of a convolution by its heuristics: the same graph
    gets the same one at each start, which does not wait for trials of all.
    """

    title = "ONNX Runtime with CUDA"
    extra = "cuda"
    advice = "NVIDIA's graphics cards; it takes the place of onnxruntime, so uninstall that first"
    substitutes = ("onnxruntime-gpu",)
    providers: ClassVar[Providers] = (
        (
            "CUDAExecutionProvider",
            {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC", "arena_extend_strategy": "kSameAsRequested"},
        ),
    )
    memory = "cuda"

    @classmethod
    def onnxruntime(cls) -> Any:
        """Import ONNX Runtime, with CUDA's libraries from NVIDIA's packages loaded where those are installed.

        Raises:
            MissingExtra: when onnxruntime is not installed, or was built without CUDA.
        """
        ort = super().onnxruntime()
        if hasattr(ort, "preload_dlls"):
            with contextlib.redirect_stdout(io.StringIO()):  # it prints what it does not find; the system may have it
                ort.preload_dlls()
        return ort
