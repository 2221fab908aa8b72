"""What builds TensorRT engines of a bundle on the board: graphs as its parser takes them, a plan, and its commands."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, RecipeError
from vlatool.export._same_actions import ROUNDING, finish_rewritten, refuse_other_actions
from vlatool.export._tensorrt_operators import refuse_unsupported, support_list
from vlatool.export._tensorrt_plan import FOLDER, ranges_from, write_plan
from vlatool.export._tensorrt_qdq import TensorrtQdq, cast_pixels
from vlatool.files.printable import one_line
from vlatool.graph.files import read, save
from vlatool.graph.opsets import fit_versions, opset_of
from vlatool.stage.base import Context, Result, Transform, source_of
from vlatool.stage.finish import MAX_ROUNDING

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

INT8_FIX = (
    "quantize for it: vlatool quantize static-int8 FLOAT32_BUNDLE --layout qdq --activations int8 -o NEW; for half "
    "precision: vlatool quantize float16"
)
REQUANTIZED_DIFFERENCE = 0.15
"""Largest relative L2 difference of actions where uint8 activations became int8, whose steps are larger."""

EXIT_WITHOUT_TENSORRT = 77
"""Exit code of ``tensorrt/build.py`` where there is no tensorrt."""


class Tensorrt(Transform):
    """Write a bundle that TensorRT engines are built of on the board: graphs as its ONNX parser takes them, and a plan.

    Pairs of quantize/dequantize become int8 around 0 with per-channel weights on axis 0 and float biases. Operators and
    types are compared with the published list of TensorRT 10.1. tensorrt/build.sh calls trtexec, tensorrt/build.py
    TensorRT's Python: strongly typed, with shapes and workspace of tensorrt/plan.json. An engine is bound to its card
    and release; it is built here only if tensorrt is installed. The actions are compared in ONNX Runtime.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy", "tensorrt")

    workspace_mb: int = Field(1024, ge=1, description="memory that building and running may use beside weights")
    shapes: tuple[str, ...] = Field((), description="lengths of an input's free axes: NAME=1x8:1x16:1x48 (min:opt:max)")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """There are graphs, and the shapes can be read."""
        if not source_of(source, self.name()).manifest.graphs:
            raise RecipeError("export tensorrt needs a bundle with graphs.", "export the policy first: vlatool export")
        ranges_from(self.shapes)

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Rewrite each graph, check its operators, write the plan, run the bundle, and compare its actions."""
        graphs, requantized = {}, list[str]()
        for number, (name, graph) in enumerate(source.manifest.graphs.items()):
            context.progress(f"rewriting {name}", number / len(source.manifest.graphs))
            (out / graph.file).parent.mkdir(parents=True, exist_ok=True)
            opset, changed = _rewrite(source.file(graph.file), out / graph.file, name)
            graphs[name] = replace(graph, opset=opset)
            requantized += changed
        files = {name: out / graph.file for name, graph in graphs.items()}
        write_plan(source, out, files, self.workspace_mb, ranges_from(self.shapes))
        made = finish_rewritten(self, source, out, graphs, context, {"engine": ""})
        return Result(made, (*self._compared(source, made, requantized), *self._built(out)))

    def _compared(self, source: Bundle, made: Bundle, requantized: list[str]) -> tuple[str, ...]:
        """Return how far the actions are from those of the source's graphs, computed operator by operator."""
        int8 = any("int8" in graph.precision for graph in made.manifest.graphs.values())
        allowed = REQUANTIZED_DIFFERENCE if requantized else MAX_ROUNDING if int8 else ROUNDING
        error = refuse_other_actions(source, made, allowed, INT8_FIX)
        said = f"in ONNX Runtime its actions differ from those of the source by up to {error:.2g}"
        if not requantized:
            return (said,)
        return (said, f"{len(requantized)} uint8 activations became int8 over the same range, with larger steps; "
                "quantize with --layout qdq --activations int8 for ranges that are chosen for it")  # fmt: skip

    def _built(self, out: Path) -> tuple[str, ...]:
        """Build the engines where tensorrt is installed; else say where to build them."""
        command = [sys.executable, "-I", str(out / FOLDER / "build.py")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == EXIT_WITHOUT_TENSORRT:
            return ("tensorrt is not installed here: no engine was built or run; on the board: sh tensorrt/build.sh",)
        if done.returncode:
            lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
            reason = one_line(lines[-1] if lines else f"exit code {done.returncode}", 300)
            raise GraphError(f"TensorRT does not build the engines: {reason}.", "build on the board: tensorrt/build.sh")
        shutil.rmtree(out / FOLDER / "engines")  # bound to this card: made again where they run
        return ("the engines were built here once, as a check; build them again on the board: sh tensorrt/build.sh",)


def _rewrite(original: Path, target: Path, name: str) -> tuple[int, list[str]]:
    """Write a graph as TensorRT's parser takes it; return its opset, and the activations with new scales."""
    known = support_list()
    model = read(original)
    refuse_unsupported(model, name, INT8_FIX, types=False)
    model = fit_versions(model, known["opset"][1], known["ir_version"])
    writer = TensorrtQdq(model, INT8_FIX)
    writer.write()
    cast_pixels(model)
    refuse_unsupported(model, name, INT8_FIX)
    save(model, target)
    return opset_of(model), writer.requantized
