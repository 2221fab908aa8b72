"""Open a graph in a process of its own first: engines crash on some quantized graphs instead of refusing them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from vlatool.errors import GraphError
from vlatool.machine.processes import python_code

CODE = """
import sys
from pathlib import Path
from vlatool.runtime.engines.openvino import OpenvinoSession
OpenvinoSession(Path(sys.argv[1]), 1)
"""
OPEN = """
import sys
from pathlib import Path
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
OrtCpuSession(Path(sys.argv[1]), 1)
"""


def compile_apart(path: Path) -> None:
    """Let a child compile the graph.

    Raises:
        GraphError: when the child was killed by a signal; a refusal is left to the engine's own message.
    """
    if signal := _killed_by(CODE, path):
        raise GraphError(
            f"OpenVINO crashes (signal {signal}) when it compiles {path.name} with these layers in int8.",
            "quantize fewer: leave out --elementwise or --attention, or use --exclude",
        )


def open_apart(path: Path) -> None:
    """Let a child open the graph in ONNX Runtime, which (1.31) crashes on some products of float16 between transposes.

    Raises:
        GraphError: when the child was killed by a signal; a refusal is left to the engine's own message.
    """
    if signal := _killed_by(OPEN, path):
        raise GraphError(
            f"ONNX Runtime crashes (signal {signal}) when it opens {path.name} with these layers in float16.",
            "leave layers beside a Transpose in float32 with --exclude, or use another method",
        )


def _killed_by(code: str, path: Path) -> int:
    """Return the signal that ends a child which runs the code on a graph; 0 when none does."""
    done = subprocess.run(python_code(code, [str(path)]), capture_output=True, check=False)
    return max(0, -done.returncode)
