"""Weight-only int4 and int8 in blocks, streamed: one tensor at a time, from safetensors shards or from a bundle."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.bundle.bundle import Bundle, hash_file, write_manifest
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.module_bundle import export_command
from vlatool.data import recorded_observations
from vlatool.errors import BundleError, DataError, require
from vlatool.files.printable import amount
from vlatool.files.resumable_work import remove_work, work_directory
from vlatool.graph.files import link
from vlatool.graph.precision import precision_shares
from vlatool.machine.host import cache_directory
from vlatool.module.sharded_weights import takes_shards
from vlatool.module.to_onnx import IMPORTS
from vlatool.quantize.streamed.graph_templates import BLOCKED_OPSET, load_templates, weights_fingerprint
from vlatool.quantize.streamed.options import WeightOptions
from vlatool.quantize.streamed.record_file import RecordFile, write_records
from vlatool.quantize.streamed.records import Record
from vlatool.quantize.streamed.tensor_jobs import records_for
from vlatool.quantize.streamed.weights_plan import WeightsPlan, make_plan
from vlatool.runtime.engine import STANDARD_LAYOUT, class_for
from vlatool.stage.base import Context, Result
from vlatool.stage.cache import STREAMS
from vlatool.stage.finish import SEED, carry_over, finish, history
from vlatool.stage.precision_shares import count_shares
from vlatool.stage.record import SampleSet, made_by

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

WEIGHTS_FILE = "graphs/weights.data"
LOSS_REPORT = "reports/weights.json"
MAX_RUN_BYTES = 1 << 30
"""Bytes of weights below which the new bundle is run, when ``verify`` is ``auto``."""
MIN_PARALLEL_WEIGHTS = 1 << 25
"""Parameters from which worker processes are worth starting."""
CALIBRATED_METHODS = ("gptq", "awq")


class WeightOnly(WeightOptions):
    """Quantize the weights of MatMul and Gemm to int4 or int8 in blocks; activations stay in float32.

    Works on one tensor at a time, so that a policy of billions of parameters needs little memory: a policy whose
    policy.yaml has ``weights`` is read from its safetensors shards, without a float32 export. Every weight is compared
    with its dequantized codes. A killed run is resumed by the next one.
    """

    packages: ClassVar[tuple[str, ...]] = ("torch", "onnx", "onnx-ir", "onnxscript", "numpy")
    imports: ClassVar[tuple[str, ...]] = IMPORTS
    streams: ClassVar[bool] = True

    def on(self, board: Profile | None) -> Self:
        """Use standard operators where the board's preferred engine takes only those."""
        standard = board is not None and class_for(board.engine).int8.get("layout") == STANDARD_LAYOUT
        return self.unless_given({"layout": STANDARD_LAYOUT} if standard else {})

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that there is something to quantize, and calibration data for the methods that need it."""
        if self.calibration and not self.calibration.exists():
            raise DataError(
                f"The calibration file {self.calibration} does not exist.",
                "check the path, or leave --calibration out for the bundle's own recording",
            )
        if source is None:
            return
        if self.method in CALIBRATED_METHODS and not recorded_observations(source, 1, self.recording):
            raise DataError(
                f"{source.path} carries no calibration data, which the method {self.method} needs.",
                "pass --calibration FILE.npz, or use --method rtn or hqq, which need none",
            )
        if source.manifest.graphs:
            super().check(source, profile)
        elif not takes_shards(source):
            raise BundleError(
                f"{source.path} has no graph to quantize, and its policy.yaml names no weights to stream.",
                f"export it first: {export_command(source.path)}; or add 'weights: \"*.safetensors\"' to policy.yaml",
            )

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Plan, stream the weights into one file, write the graphs, and verify."""
        for package in ("onnx", "onnx_ir"):
            require(package, "build")
        context.progress("reading the graphs", None)
        (out / "graphs").mkdir()
        plan = make_plan(load_templates(source, BLOCKED_OPSET), self, source, WEIGHTS_FILE)
        samples = SampleSet() if self.method in CALIBRATED_METHODS else None
        with work_directory(self.work(source)) as directory:
            records = self._records(plan, source, directory, samples)
            written = write_records(
                records, self._identity(plan, source), directory, _processes(records), context.progress
            )
            link(written.path, out / WEIGHTS_FILE)
            quantized = self._finish(plan, source, out, written, samples, context)
            remove_work(directory)
        return quantized

    def _finish(
        self,
        plan: WeightsPlan,
        bundle: Bundle,
        out: Path,
        written: RecordFile,
        samples: SampleSet | None,
        context: Context,
    ) -> Result:
        """Write the graphs and all other files, and verify."""
        opsets = plan.save(out)
        carry_over(bundle, out)
        recorded = {**made_by(self, calibration=samples), **_summarize(written, out / LOSS_REPORT)}
        context.progress("counting", None)
        runs = self.verify == "run" or (self.verify == "auto" and written.bytes < MAX_RUN_BYTES)
        graphs, messages = {}, tuple[str, ...]()
        for name, opset in opsets.items():
            file = out / f"graphs/{name}.onnx"
            shares, uncounted = count_shares(file) if runs else (precision_shares(file), ())
            messages += uncounted
            graphs[name] = Graph(f"graphs/{name}.onnx", shares, opset)
        if not runs:
            return Result(_seal(bundle, out, written, recorded, graphs))
        context.progress("running the quantized graphs", None)
        made = finish(bundle, out, made_by=recorded, graphs=graphs, **self.golden_arguments(bundle))
        return Result(made, messages)

    def work(self, source: Bundle) -> Path:
        """Return the directory of unfinished work on a source."""
        weights = hashlib.sha256(f"{self.key(source.hash)} {weights_fingerprint(source)}".encode()).hexdigest()
        return cache_directory() / STREAMS / f"{self.name()}-{weights[:16]}"

    def summarize(self, quantized: Bundle) -> tuple[str, ...]:
        """Return a summary of the new bundle for the user."""
        report = json.loads((quantized.path / LOSS_REPORT).read_text(encoding="utf-8"))
        again = f", {report['resumed']} of them from the run before" if report["resumed"] else ""
        if not report["layers"]:
            return ("no layer was quantized",)
        return (
            f"{amount(len(report['layers']), 'weight')} in int{self.bits}, blocks of {self.block}{again}; relative L2 "
            f"error: mean {report['mean']:.4f}, largest {report['max']:.4f} ({report['worst']})",
            *self._underdetermined_layers(report["layers"]),
        )

    def _underdetermined_layers(self, layers: list[dict[str, Any]]) -> Iterator[str]:
        """Warn of layers with more inputs than rows of activations, whose rounding is underdetermined."""
        underdetermined = [note for note in layers if note.get("rows", math.inf) < note.get("inputs", 0)]
        if underdetermined:
            worst = max(underdetermined, key=lambda note: note["inputs"] / note["rows"])
            others = f" (as {len(underdetermined) - 1} others)" if underdetermined[1:] else ""
            yield (
                f"warning: {worst['layer']} has {worst['inputs']} inputs, the samples give it {worst['rows']} rows: "
                f"too few to decide how {self.method} rounds it{others}; record more and raise --samples, or use "
                "--method rtn"
            )

    def _records(self, plan: WeightsPlan, bundle: Bundle, directory: Path, samples: SampleSet | None) -> list[Record]:
        if samples is not None:
            from vlatool.quantize.streamed.sequential_calibration import calibrated_records

            return calibrated_records(plan, bundle, self, directory, samples)
        tolerance = self.block_format.largest_error
        return [
            record for task in plan.tasks for record in records_for(task, self.block_format, self.choose, tolerance)
        ]

    def _identity(self, plan: WeightsPlan, bundle: Bundle) -> str:
        content = [self.key(bundle.hash), weights_fingerprint(bundle), plan.identity()]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _processes(records: list[Record]) -> int:
    """Return the number of worker processes: one more than cores, since workers wait for the disk at times."""
    work = sum(record.weights for record in records if record.portable)
    return min(len(os.sched_getaffinity(0)), 8) + 1 if work >= MIN_PARALLEL_WEIGHTS else 0


def _summarize(written: RecordFile, file: Path) -> dict[str, Any]:
    """Write the loss of every layer to ``reports/weights.json``; return its entries for the manifest."""
    layers = [note for note in written.notes if "error" in note]
    errors = [note["error"] for note in layers]
    worst = max(layers, key=lambda note: note["error"])["layer"] if layers else ""
    mean = sum(errors) / len(errors) if errors else 0.0
    summary = {"mean": round(mean, 6), "max": round(max(errors, default=0.0), 6), "worst": worst}
    file.parent.mkdir(exist_ok=True)
    report = {**summary, "resumed": written.resumed, "layers": layers}
    file.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    identity = sorted(f"{note['tensor']}:{note.get('first', 0)}:{note['sha256']}" for note in written.notes)
    digest = hashlib.sha256("\n".join(identity).encode()).hexdigest()
    return {"weights_sha256": digest, "weight_error": summary}


def _seal(bundle: Bundle, out: Path, written: RecordFile, made_by: dict[str, Any], graphs: dict[str, Graph]) -> Bundle:
    """Write the manifest without running the graphs; the large file was hashed during writing."""
    files = {WEIGHTS_FILE: FileRecord(written.sha256, written.bytes)}
    for path in sorted(path for folder in ("assets", "data", "graphs") for path in (out / folder).rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_file() and name != WEIGHTS_FILE:
            files[name] = FileRecord(hash_file(path), path.stat().st_size)
    origin = {key: value for key, value in bundle.manifest.source.items() if key != "arguments"}
    hashes = {name: record.sha256 for name, record in files.items() if name.startswith("graphs/")}
    step = {**made_by, "seed": SEED, "input": bundle.hash, "graphs": hashes}
    manifest: Manifest = replace(
        bundle.manifest,
        parent=bundle.hash,
        made_by=made_by,
        graphs=graphs,
        accuracy={},
        golden="",
        build=(*history(bundle), step),
        source=origin,
        files=dict(sorted(files.items())),
    )
    write_manifest(out, manifest)
    return Bundle(out, manifest)
