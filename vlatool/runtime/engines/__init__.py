"""Inference libraries, one file each: the only ones that open one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vlatool.errors import require
from vlatool.runtime.engines._onnx_runtime import OnnxRuntimeSession as OnnxRuntimeSession
from vlatool.runtime.engines._onnx_runtime import open_session, profiling_session

if TYPE_CHECKING:
    from pathlib import Path

    from vlatool.runtime.engines._ort_profile import OrtProfiled
    from vlatool.runtime.engines._reference import BranchesSession, ReferenceSession


def reference() -> type[ReferenceSession]:
    """Return the session that computes each operator as it is written: the reference that engines are compared with.

    Raises:
        MissingExtra: when the library that computes so is not installed.
    """
    from vlatool.runtime.engines._reference import ReferenceSession

    return ReferenceSession


def of_branches() -> type[BranchesSession]:
    """Return the session for graphs that quantize in the branches of ``If``, in the library that runs float32 answers.

    Raises:
        MissingExtra: when the library is not installed.
    """
    from vlatool.runtime.engines._reference import BranchesSession

    return BranchesSession


def build_tool(name: str) -> Any:
    """Import one of the tools for graphs that come with ONNX Runtime: ``quantization``, ``transformers.float16``.

    Raises:
        MissingExtra: when onnx or onnxruntime is not installed.
    """
    require("onnx", "build")
    return require(f"onnxruntime.{name}", "ort")


def open_traced(path: Path, scratch: Path) -> OrtProfiled:
    """Open a graph as it is written, without any rewriting, to see what its nodes are fed and give.

    Raises:
        GraphError: when ONNX Runtime refuses it.
        MissingExtra: when onnxruntime is not installed.
    """
    ort = require("onnxruntime", "ort")
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    return profiling_session(ort, path, options, scratch)


def node_session(content: bytes) -> Any:
    """Open a graph of one node, of whatever types and shapes it is fed, in ONNX Runtime's own session.

    Raises:
        MissingExtra: when onnxruntime is not installed.
    """
    ort = require("onnxruntime", "ort")
    options = ort.SessionOptions()
    options.log_severity_level = 4
    return open_session(ort, content, options)
