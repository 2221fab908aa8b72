"""ONNX Runtime on a graphics card of NVIDIA, through its TensorRT provider."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from vlatool.machine.host import versions
from vlatool.runtime.engines._engine_cache import EngineCache
from vlatool.runtime.engines._onnx_runtime import Providers, is_true_of
from vlatool.runtime.engines.ort_cuda import OrtCudaSession
from vlatool.runtime.stored_types import FLOAT16, INT8, holds_type

TENSORRT = "TensorrtExecutionProvider"
WORKSPACE_BYTES = 1 << 30
"""Memory that TensorRT may use beside weights while it builds and runs an engine; as ``vlatool export tensorrt``."""
PACKAGES = ("tensorrt", "tensorrt-cu12", "tensorrt-cu13")
LIBRARIES = ("libnvinfer.so.10", "libnvinfer.so.8", "libnvinfer.so")


class OrtTensorrtSession(OrtCudaSession):
    """One ONNX file open in ONNX Runtime on TensorRT; nodes that TensorRT does not take run on CUDA's provider.

    A node that neither runs is an error: none moves to the processor. TensorRT builds its engine when the session is
    opened, which takes from seconds to minutes, and keeps it in ``EngineCache``. Its options follow from what the graph
    holds: int8 pairs and float16 tensors are computed so. Float32 is computed as TF32 where the variable
    ``NVIDIA_TF32_OVERRIDE`` is not 0.

    Args:
        path, threads, compute, opened, traced: As for every engine on ONNX Runtime.
        cache: Hash of the graph and its weights; nothing is kept when empty.
        shapes: Shape of each input of the graph, as far as known: where all are, the engine is built for these.
    """

    title = "ONNX Runtime with TensorRT"
    advice = "NVIDIA's graphics cards; TensorRT's libraries are installed apart: pip install tensorrt, or JetPack"
    int8: ClassVar[Mapping[str, Any]] = {"layout": "qdq", "activations": "int8"}
    providers: ClassVar[Providers] = ((TENSORRT, {}), *OrtCudaSession.providers)
    caches = True

    def __init__(
        self,
        path: Path,
        threads: int | None = None,
        compute: str = "",
        opened: Path | bytes | None = None,
        traced: bool = False,
        cache: str = "",
        shapes: Mapping[str, tuple[int, ...]] | None = None,
    ) -> None:
        self._shapes = shapes or {}
        parts = (cache, compute, self.identity(), repr(sorted(self._shapes.items())))
        self.cache = EngineCache(parts) if cache else None
        super().__init__(path, threads, compute, opened, traced)

    @classmethod
    def identity(cls) -> str:
        """Return what an engine is bound to: providers, packages, cards, driver, board, and TensorRT's release."""
        return "; ".join([super().identity(), *cls.hardware(), f"TensorRT {tensorrt_version() or 'unknown'}"])

    def _providers_for(self, model: Path | bytes) -> Providers:
        options = {"trt_max_workspace_size": str(WORKSPACE_BYTES)}
        if is_true_of(holds_type, FLOAT16, model):
            options["trt_fp16_enable"] = "1"
        if is_true_of(holds_type, INT8, model):
            options["trt_int8_enable"] = "1"
        if self.cache is not None:
            kinds = {"trt_engine_cache": self.cache.path, "trt_timing_cache": self.cache.path}
            options |= {f"{kind}_enable": "1" for kind in kinds}
            options |= {f"{kind}_path": str(path) for kind, path in kinds.items()}
        if self._shapes:
            listed = ",".join(f"{name}:{'x'.join(map(str, shape))}" for name, shape in self._shapes.items())
            options |= {f"trt_profile_{bound}_shapes": listed for bound in ("min", "opt", "max")}
        (tensorrt, _), *others = self.providers
        return ((tensorrt, options), *others)


def tensorrt_version() -> str:
    """Return TensorRT's release, from its package or its library; empty where there is none."""
    if known := versions(PACKAGES):
        return next(iter(known.values()))
    for name in LIBRARIES:
        with contextlib.suppress(OSError, AttributeError):
            return str(ctypes.CDLL(name).getInferLibVersion())
    return ""
