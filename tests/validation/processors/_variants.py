"""The bundles that are tried on other processors: how each is made, and how far its actions may be from the host's."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.stage.finish import MAX_ROUNDING

ROOT = Path(__file__).parents[3]
SAMPLES = ("sample_models/vln-babyai", "sample_models/vla-metaworld")
FLOAT_LIMIT = 1e-5
"""What sums of float32 in another order make; seen up to 6e-7."""
INT8_LIMIT = 0.01
"""What they make where they are rounded to int8 in between; seen up to 1.8e-3 between an ARM and an x86 processor."""
HALF_LIMIT = 0.02
"""The same of float16, which is computed as such or in float32; seen up to 5.5e-3. What is in int4 is held against
``ROUNDING``: activations beside it are rounded to int8 on some processors and not on others; seen up to 0.020."""
STATIC = ("quantize", "static-int8")
OPENVINO = (*STATIC, "--layout", "openvino")


@dataclass(frozen=True)
class Variant:
    """A kind of bundle.

    Args:
        name: What the table calls it, and its folder.
        command: Words of ``vlatool`` that make it of the float32 bundle; the float32 bundle itself when empty.
        limit: Largest relative L2 difference of its actions that is rounding.
        engines: Engines that it is tried with.
        optional: Whether a processor may lack what making it needs.
    """

    name: str
    command: tuple[str, ...]
    limit: float = INT8_LIMIT
    engines: tuple[str, ...] = ("ort_cpu",)
    optional: bool = False


class VariantError(Exception):
    """What the user is told instead of a traceback."""


BOTH = ("ort_cpu", "openvino")
FLOAT = Variant("float32", (), FLOAT_LIMIT, BOTH)
FOR_ARM = (
    FLOAT,
    Variant("dynamic-int8", ("quantize", "dynamic-int8")),
    Variant("ort uint8", STATIC),
    Variant("ort attention", (*STATIC, "--attention")),
    Variant("ort int8", (*STATIC, "--activations", "int8")),
    Variant("qdq uint8", (*STATIC, "--layout", "qdq")),
    Variant("qdq int8", (*STATIC, "--layout", "qdq", "--activations", "int8")),
    Variant("int4", ("quantize", "weight-only"), MAX_ROUNDING),
    Variant("int4 qdq", ("quantize", "weight-only", "--layout", "qdq"), MAX_ROUNDING),
    Variant("float16", ("quantize", "float16"), HALF_LIMIT),
)
"""What ONNX Runtime runs on 64-bit ARM."""
FOR_X86 = (
    FLOAT,
    *(Variant(each.name, each.command, MAX_ROUNDING, BOTH) for each in FOR_ARM[1:]),
    Variant("ort 7-bit", (*STATIC, "--reduce-range"), MAX_ROUNDING, BOTH),
    Variant("ort 8-bit", (*STATIC, "--no-reduce-range"), MAX_ROUNDING, BOTH),
    Variant("openvino", OPENVINO, MAX_ROUNDING, BOTH),
    Variant("openvino uint8", (*OPENVINO, "--activations", "uint8"), MAX_ROUNDING, BOTH),
    Variant("openvino 7-bit", (*OPENVINO, "--reduce-range"), MAX_ROUNDING, BOTH),
    Variant("openvino convolutions", (*OPENVINO, "--convolutions"), MAX_ROUNDING, BOTH),
    Variant("openvino bfloat16", (*OPENVINO, "--compute", "bfloat16"), MAX_ROUNDING, ("openvino",), optional=True),
    Variant("bfloat16", ("quantize", "bfloat16"), MAX_ROUNDING, ("openvino",), optional=True),
)
"""What an x86 host can be given."""


@dataclass(frozen=True)
class Made:
    """The bundles of one policy.

    Args:
        name: Of the policy.
        folder: Variant -> bundle.
        refused: Variant -> why ``vlatool`` did not make it.
        observations: File with recorded observations that numpy alone reads.
        recorded: How many there were to choose from.
        chosen: How many are in the file.
    """

    name: str
    bundles: dict[str, Path]
    refused: dict[str, str]
    observations: Path
    recorded: int
    chosen: int


def make(source: str, variants: Sequence[Variant], out: Path, count: int) -> Made:
    """Export a policy and make every variant of it, with some of its recorded observations beside them.

    Args:
        source: What ``vlatool export`` takes.
        variants: Which bundles; float32 is always made.
        out: A folder, for this policy alone.
        count: Observations, spread evenly over the recording; all when 0.

    Raises:
        VariantError: when the policy cannot be exported, or has no recorded observations.
    """
    bundles, refused = {FLOAT.name: out / FLOAT.name}, {}
    if error := vlatool("export", source, "-o", str(out / FLOAT.name)):
        raise VariantError(f"{source} cannot be exported: {error}")
    for variant in variants:
        if not variant.command:
            continue
        place = out / folder(variant)
        error = vlatool(*variant.command, str(bundles[FLOAT.name]), "-o", str(place))
        bundles[variant.name] = place
        if error:
            refused[variant.name] = error
            del bundles[variant.name]
    chosen, recorded = observations(bundles[FLOAT.name], count)
    np.savez(out / "observations.npz", **chosen)
    number = len(next(iter(chosen.values())))
    return Made(Path(source).name, bundles, refused, out / "observations.npz", recorded, number)


def folder(variant: Variant) -> str:
    """Return the name of its directory."""
    return variant.name.replace(" ", "-")


def vlatool(*words: str) -> str:
    """Run a command of vlatool, and return what it says when it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "vlatool", *words, "--force"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    lines = [line for line in lines if line.startswith("error: ")] or lines
    return "" if not done.returncode else (lines[-1] if lines else f"it left with {done.returncode}")


def observations(bundle: Path, count: int) -> tuple[dict[str, Any], int]:
    """Return recorded observations, input -> array with a leading sample axis, and how many there were.

    Raises:
        VariantError: when the bundle carries none.
    """
    from vlatool.bundle.bundle import Bundle
    from vlatool.data import read_recording, recordings_of

    opened = Bundle.open(bundle)
    evaluation = recordings_of(opened).evaluation
    if evaluation is None:
        raise VariantError(f"{bundle} carries no recorded observations.")
    recording = read_recording(evaluation, opened.manifest.spec)
    rows = recording.spread(count or len(recording))
    return {name: values[rows] for name, values in recording.inputs.items()}, len(recording)
