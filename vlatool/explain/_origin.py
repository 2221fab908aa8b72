"""The quantization that made a bundle, its float32 baseline, and observations to run both on."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.data import NamedRecording, recorded_observations, recordings_of, synthetic_observations
from vlatool.errors import BundleError, VlatoolError
from vlatool.graph.precision import FLOATS
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.stage.base import Stage
from vlatool.stage.build import stage_class, stage_from
from vlatool.stage.run import cache_directory

INT8 = (StaticInt8, DynamicInt8)


@dataclass(frozen=True)
class Origin:
    """The quantization that made a bundle.

    Args:
        stage: The stage with its options; None when the bundle was not quantized.
        inputs: Hashes of bundles that it may have started from, the likeliest first.
        notes: Notes on options that could not be adopted.
    """

    stage: Stage | None = None
    inputs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def int8(self) -> bool:
        """Whether its layers can be switched to int8 one by one."""
        return isinstance(self.stage, INT8)


@dataclass(frozen=True)
class Observations:
    """Observations to run the bundles on.

    Args:
        words: Description of their source.
        recorded: Whether they are recorded, so that errors on them are meaningful.
    """

    values: Sequence[dict[str, Any]] = ()
    words: str = ""
    recorded: bool = True


def origin(bundle: Bundle) -> Origin:
    """Return the last quantization in a bundle's history."""
    manifest = bundle.manifest
    for entry in (*reversed(manifest.build), manifest.made_by):
        name = str(entry.get("stage", ""))
        if not name.startswith("quantize."):
            continue
        inputs = tuple(dict.fromkeys(text for text in (str(entry.get("input", "")), manifest.parent) if text))
        stage, notes = _stage(name, entry.get("options", {}))
        return Origin(stage, inputs, notes)
    return Origin()


def _stage(name: str, options: Mapping[str, Any]) -> tuple[Stage | None, tuple[str, ...]]:
    """Return the stage, without options that name files."""
    try:
        kind = stage_class(name)
    except VlatoolError:
        return None, (f"this vlatool does not know the stage {name}",)
    kept = {
        key: value for key, value in options.items() if key in kind.model_fields and key not in ("calibration", "map")
    }
    notes = tuple(f"the option {key}: {value} was not adopted" for key, value in options.items() if key not in kept)
    try:
        return stage_from(kind, kept, name), notes
    except VlatoolError as error:
        return None, (*notes, error.message)


def find_baseline(bundle: Bundle, quantization: Origin, path: Path | None) -> Bundle | None:
    """Return the float32 bundle that a bundle was quantized from: the given one, or one in the cache.

    Raises:
        BundleError: when the given one is damaged, belongs to another policy, or is quantized.
    """
    if path is None:
        return _cached_bundle(quantization.inputs)
    baseline = Bundle.open(path)
    missing = [name for name in bundle.manifest.graphs if name not in baseline.manifest.graphs and not _phases(name)]
    kinds = sorted({kind for graph in baseline.manifest.graphs.values() for kind in graph.precision} - {*FLOATS})
    if missing or kinds or baseline.manifest.spec != bundle.manifest.spec:
        what = f"it has no graph '{missing[0]}'" if missing else "its inputs or outputs differ"
        what = f"it is quantized itself ({', '.join(kinds)})" if kinds else what
        raise BundleError(
            f"{path} is not what {bundle.path} was made from: {what}.",
            "name the float32 bundle of the same policy: vlatool export SOURCE -o BUNDLE",
        )
    return baseline


def _phases(name: str) -> bool:
    return name.endswith("_phases")


def _cached_bundle(hashes: tuple[str, ...]) -> Bundle | None:
    """Return a bundle in the cache with one of the hashes."""
    for path in sorted((cache_directory() / "stages").glob(f"*/{MANIFEST}")):
        if "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest() in hashes:
            try:
                bundle = Bundle.open(path.parent)
            except BundleError:
                continue
            if bundle.manifest.graphs:
                return bundle
    return None


def observations_of(bundle: Bundle, baseline: Bundle | None, data: NamedRecording | None, count: int) -> Observations:
    """Return observations, preferably unused in calibration; raises DataError when the data does not fit the policy."""
    if data is not None:
        return Observations(recorded_observations(bundle, count, data), data.path.name)
    sources = [candidate for candidate in (bundle, baseline) if candidate is not None]
    for source in sources:
        if (held_out := recordings_of(source).evaluation) is not None:
            values = recorded_observations(source, count, held_out)
            return Observations(values, "recorded observations that calibration has not seen")
    for source in sources:
        if values := recorded_observations(source, count):
            return Observations(values, "the calibration's own observations")
    return Observations(synthetic_observations(bundle, count), "synthetic observations", recorded=False)


def sensitivity_stage(stage: Stage | None) -> StaticInt8 | None:
    """Return the static stage with the layers of an int8 stage; None for other stages."""
    if isinstance(stage, StaticInt8):
        return stage
    if isinstance(stage, DynamicInt8):
        same = ("include", "exclude", "parts", "graphs", "per_channel", "reduce_range")
        return StaticInt8(ops=("MatMul", "Gemm"), **{name: getattr(stage, name) for name in same})
    return None


def command(stage: Stage, source: str) -> str:
    """Return the command line that runs a stage."""
    words = [f"vlatool quantize {stage.name().partition('.')[2].replace('_', '-')} {source} -o BUNDLE"]
    for name, value in stage.options().items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, list):
            words += [f"--{flag} '{item}'" for item in value]
        else:
            words.append(f"--{flag} {value}")
    return " ".join(words)
