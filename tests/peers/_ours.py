"""The bundles of vlatool that take part when none, or more, are given on the command line."""

from __future__ import annotations

from pathlib import Path

from _workload import Array, Feeds, Infer, Workload, fresh, run_vlatool

MARK = "ours:"
OPENVINO = ("quantize", "static-int8", "{bundle}", "--layout", "openvino", "--compute", "bfloat16")
COMMANDS: dict[str, tuple[str, ...]] = {
    "optimize, relative_error 0.04": ("optimize", "{policy}", "--max-drop", "relative_error=0.04"),
    "optimize for ONNX Runtime, relative_error 0.04": (
        *("optimize", "{policy}", "--profile", "raspberry-pi-5", "--max-drop", "relative_error=0.04"),
    ),
    "openvino bf16": OPENVINO,
    "openvino bf16, mse": (*OPENVINO, "--method", "mse"),
    "openvino bf16, attention": (*OPENVINO, "--attention"),
    "openvino bf16, mse, attention": (*OPENVINO, "--method", "mse", "--attention"),
    "openvino bf16, elementwise": (*OPENVINO, "--elementwise"),
    "openvino bf16, elementwise, attention": (*OPENVINO, "--elementwise", "--attention"),
    "openvino bf16, convolutions": (*OPENVINO, "--convolutions"),
    "openvino bf16, mse, convolutions": (*OPENVINO, "--method", "mse", "--convolutions"),
    "static-int8": ("quantize", "static-int8", "{bundle}"),
    "static-int8, attention": ("quantize", "static-int8", "{bundle}", "--attention"),
    "static-int8, mse, attention": ("quantize", "static-int8", "{bundle}", "--method", "mse", "--attention"),
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
    words = [word.format(bundle=workload.bundle, policy=workload.policy) for word in COMMANDS[name]]
    with fresh(target) as draft:
        run_vlatool(*words, "-o", str(draft))


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
