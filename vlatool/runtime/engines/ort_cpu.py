"""ONNX Runtime on the CPU."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError, require

PROVIDER = "CPUExecutionProvider"


class OrtCpuSession:
    """One ONNX file open in ONNX Runtime on the CPU, with fallback to other providers off.

    Args:
        path: The ONNX file; external data is found beside it.
        threads: Intra-op threads; the cores that this process may use when None.

    Raises:
        GraphError: when ONNX Runtime refuses the file, or opened it on another provider.
        MissingExtra: when onnxruntime is not installed.
    """

    def __init__(self, path: Path, threads: int | None = None) -> None:
        ort = require("onnxruntime", "ort")
        options = ort.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
        options.inter_op_num_threads = 1
        try:
            self._session = ort.InferenceSession(str(path), options, providers=[PROVIDER], enable_fallback=0)
        except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
            raise GraphError(f"ONNX Runtime {ort.__version__} refuses {path}: {_first_line(error)}") from error
        self._session.disable_fallback()
        self.providers = list(self._session.get_providers())
        if self.providers != [PROVIDER]:
            raise GraphError(f"{path} was opened on {', '.join(self.providers)}; wanted {PROVIDER}.")
        self.path = path
        self._run = self._session.run
        self.outputs = [node.name for node in self._session.get_outputs()]
        self.inputs = {node.name: (list(node.shape), str(node.type)) for node in self._session.get_inputs()}

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array.

        Raises:
            GraphError: when ONNX Runtime fails on these inputs.
        """
        try:
            return dict(zip(self.outputs, self._run(self.outputs, feeds), strict=True))
        except Exception as error:
            raise GraphError(f"ONNX Runtime failed in {self.path.name}: {_first_line(error)}") from error

    @staticmethod
    def version() -> str:
        """Version of the engine.

        Raises:
            MissingExtra: when onnxruntime is not installed.
        """
        return str(require("onnxruntime", "ort").__version__)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:300]
