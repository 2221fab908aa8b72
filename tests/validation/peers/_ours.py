"""The bundles of vlatool that take part when none, or more, are given on the command line."""

from __future__ import annotations

import re
from pathlib import Path

from _workload import ROOT, Array, Feeds, Infer, Workload, fresh, run_vlatool

from vlatool.machine.host import isa
from vlatool.runtime.engines.openvino import BF16

MARK = "ours:"
HALF = "bf16" if any(feature in (isa() or ()) for feature in BF16) else "f32"
"""What OpenVINO computes in here that is not int8: bfloat16 where the processor has it."""
OPENVINO = ("quantize", "static-int8", "{bundle}", "--layout", "openvino")
OPENVINO = (*OPENVINO, "--compute", "bfloat16") if HALF == "bf16" else OPENVINO
STATIC = ("quantize", "static-int8", "{bundle}")
OPTIMIZE = "optimize"
SEARCH, SEARCH_ORT = "optimize, relative_error 0.04", "optimize for ONNX Runtime, relative_error 0.04"
COMMANDS: dict[str, tuple[str, ...]] = {
    SEARCH: (OPTIMIZE, "{policy}", "--max-drop", "relative_error=0.04"),
    SEARCH_ORT: (OPTIMIZE, "{policy}", "--profile", "{ort_alone}", "--max-drop", "relative_error=0.04"),
    f"openvino {HALF}": OPENVINO,
    f"openvino {HALF}, mse": (*OPENVINO, "--method", "mse"),
    f"openvino {HALF}, attention": (*OPENVINO, "--attention"),
    f"openvino {HALF}, mse, attention": (*OPENVINO, "--method", "mse", "--attention"),
    f"openvino {HALF}, elementwise": (*OPENVINO, "--elementwise"),
    f"openvino {HALF}, elementwise, attention": (*OPENVINO, "--elementwise", "--attention"),
    "openvino bf16, convolutions": (*OPENVINO, "--convolutions"),
    "openvino bf16, mse, convolutions": (*OPENVINO, "--method", "mse", "--convolutions"),
    "static-int8": STATIC,
    "static-int8, attention": (*STATIC, "--attention"),
    "static-int8, mse, attention": (*STATIC, "--method", "mse", "--attention"),
    "static-int8, elementwise": (*STATIC, "--elementwise"),
    "static-int8, all 8 bits": (*STATIC, "--no-reduce-range"),
    "dynamic-int8": ("quantize", "dynamic-int8", "{bundle}"),
    "bfloat16": ("quantize", "bfloat16", "{bundle}"),
    "bfloat16, convolutions": ("quantize", "bfloat16", "{bundle}", "--convolutions"),
    "float32": (),
}
"""Name -> ``vlatool`` command that makes the bundle; the float32 bundle itself when empty."""


def bundle_of(workload: Workload, name: str) -> Path:
    """Return where the bundle of a default command is kept."""
    if not COMMANDS[name]:
        return workload.bundle
    return workload.folder / "ours" / "".join(letter if letter.isalnum() else "-" for letter in name)


def make(workload: Workload, name: str) -> None:
    """Run the command unless its bundle is there."""
    target = bundle_of(workload, name)
    if target.is_dir():
        return
    places = {"bundle": workload.bundle, "policy": workload.policy, "ort_alone": onnx_runtime_alone(workload)}
    words = [word.format(**places) for word in COMMANDS[name]]
    with fresh(target) as draft:
        run_vlatool(*words, "-o", str(draft))


def onnx_runtime_alone(workload: Workload) -> Path:
    """Write a profile of this processor's instruction set with ONNX Runtime alone, and return it.

    The profile of a board with another set would be optimised for that set, and measured in this one.
    """
    text = (ROOT / "profiles" / "raspberry-pi-5.yaml").read_text(encoding="utf-8")
    profile = workload.folder / "onnx-runtime-alone.yaml"
    profile.write_text(re.sub(r"isa: \[.*\]", f"isa: [{', '.join(isa() or ())}]", text), encoding="utf-8")
    return profile


def open_bundle(workload: Workload, path: Path) -> tuple[Infer, list[Feeds]]:
    """Open a bundle as a controller does; return one inference, the runtime's work included, and raw observations."""
    import vlatool.runtime
    from vlatool.bundle.bundle import Bundle
    from vlatool.data import read_recording

    policy = vlatool.runtime.load(path, threads=1)
    source = Bundle.open(workload.bundle)
    recording = read_recording(source.path / "data" / "evaluation.npz", source.manifest.spec)
    action = policy.spec.action.name

    def infer(observation: Feeds) -> Array:
        return policy.infer(observation).outputs[action]

    return infer, list(recording)
