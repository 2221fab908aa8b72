"""OpenVINO's own files (IR) of a bundle, run and compared with what its graphs say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import GraphError, RecipeError
from vlatool.export._interface import graph_entry, write_interface
from vlatool.export._same_actions import OBSERVATIONS, finish_rewritten, largest_difference
from vlatool.files.blob_store import link_or_copy
from vlatool.files.printable import amount, message_of, one_line
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage.base import Context, Result, Transform, source_of
from vlatool.stage.finish import SEED, reference_policy

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

ENGINE = "openvino"
FOLDER = "openvino"
HINTS = {"": "f32", "float32": "f32", "bfloat16": "bf16"}
"""What a consumer must ask OpenVINO to compute in: left alone, it takes bfloat16 where the processor has it."""
FLOAT_DIFFERENCE = 1e-3
"""Largest relative L2 difference of float32 actions: kernels add up in another order."""
INTEGER_DIFFERENCE = 0.045
"""The same where a graph rounds to int8: a rounding that falls the other way carries on."""
ROUNDS_FIX = (
    "its int8 kernels round otherwise on this processor; compare its actions (vlatool evaluate recorded BUNDLE "
    "--engine openvino --baseline FLOAT32_BUNDLE), leave layers in float32 (quantize ... --exclude)"
)
"""For a bundle that was quantized for OpenVINO."""
INT8_FIX = "quantize for OpenVINO: vlatool quantize static-int8 FLOAT32_BUNDLE --layout openvino -o NEW"


class Openvino(Transform):
    """Write OpenVINO's IR (openvino/NAME.xml and .bin) of every graph beside a bundle, and run it.

    The IR holds what the ONNX graph holds: float32, or int8 as quantize/dequantize pairs. It is accepted only if
    OpenVINO gives with it, through the whole program, what the graphs say on recorded observations.
    openvino/interface.json says what it takes and gives.
    """

    packages: ClassVar[tuple[str, ...]] = ("openvino", "onnx", "onnxruntime", "numpy")

    compress: bool = Field(False, description="store float32 weights as float16 in the .bin, half as large")
    tolerance: float | None = Field(
        None, gt=0, description="largest relative L2 difference of an output; by default 0.001, with int8 0.045"
    )

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """OpenVINO is installed, and there are graphs."""
        engine_class(ENGINE).library()
        if not source_of(source, self.name()).manifest.graphs:
            raise RecipeError("export openvino needs a bundle with graphs.", "export the policy first: vlatool export")

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Write the IR of each graph, finish the bundle, run the IR, and compare."""
        carry_graphs(source, out)
        (out / FOLDER).mkdir()
        entries = {}
        for number, (name, graph) in enumerate(source.manifest.graphs.items()):
            context.progress(f"converting {name}", number / len(source.manifest.graphs))
            model = out / FOLDER / f"{name}.xml"
            with engine_call(engine_class(ENGINE), f"converted the graph '{name}'"):
                self._convert(out / graph.file, model)
            files = {"model": model, "weights": model.with_suffix(".bin")}
            settings = {"INFERENCE_PRECISION_HINT": HINTS[graph.compute]}
            entries[name] = {**graph_entry(source, name, out / graph.file, files, out), "settings": settings}
        write_interface(out / FOLDER / "interface.json", source, entries)
        made = finish_rewritten(self, source, out, source.manifest.graphs, context)
        observations = observations_for(source, OBSERVATIONS)
        with engine_call(engine_class(ENGINE), "ran the IR"):
            error = self._compare(made, observations)
        size = sum(file.stat().st_size for file in (out / FOLDER).iterdir()) / 1e6
        count = len(observations)
        return Result(made, (
            f"OpenVINO {engine_class(ENGINE).version()}: {FOLDER}/ with {amount(len(entries), 'graph')}, {size:.2f} "
            f"MB; its actions differ from what the graphs say by up to {error:.2g} on {amount(count, 'observation')}",
        ))  # fmt: skip

    def _convert(self, original: Path, model: Path) -> None:
        openvino = engine_class(ENGINE).library()
        try:
            openvino.save_model(openvino.Core().read_model(str(original)), str(model), compress_to_fp16=self.compress)
        except Exception as error:  # the seam: OpenVINO raises many foreign types
            reason = one_line(message_of(error).replace(str(original), original.name), 300)
            raise GraphError(f"OpenVINO does not take the graph {original.name}: {reason}.", INT8_FIX) from error

    def _compare(self, made: Bundle, observations: list[dict[str, Any]]) -> float:
        """Return the largest difference of what OpenVINO gives with the IR from what the graphs say."""
        whole = {kind for graph in made.manifest.graphs.values() for kind in graph.precision} <= {"float32"}
        allowed = self.tolerance or (FLOAT_DIFFERENCE if whole and not self.compress else INTEGER_DIFFERENCE)
        policy = policy_of_files(made, lambda name: made.path / FOLDER / f"{name}.xml", ENGINE)
        error = largest_difference(reference_policy(made), policy, observations)
        if not error <= allowed:
            raise GraphError(
                f"OpenVINO gives other actions with the IR than the graphs say: relative L2 error {error:.3g} on "
                f"{amount(len(observations), 'observation')}, allowed {allowed:g}.",
                f"{ROUNDS_FIX if made.manifest.engine == ENGINE else INT8_FIX}; or raise --tolerance if you know why",
            )
        return error


def carry_graphs(source: Bundle, out: Path) -> None:
    """Copy the graphs of a bundle with the files of their weights; large ones are shared."""
    for name, record in source.manifest.files.items():
        if name.startswith("graphs/"):
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            link_or_copy(source.file(name), out / name, record.sha256)


def policy_of_files(bundle: Bundle, file: Callable[[str], Path], engine: str) -> Policy:
    """Return a bundle's policy whose graphs are opened from other files, by name of the graph."""
    opened: Any = engine_class(engine)
    sessions = {name: opened(file(name), 1, graph.compute) for name, graph in bundle.manifest.graphs.items()}
    return Policy(bundle, Program(bundle.manifest.program, sessions, SEED), engine)
