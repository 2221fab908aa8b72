"""Files and directories of other tools that no source reads: what they are, and what to name or do instead."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from vlatool.errors import SourceError
from vlatool.files.json import read_json
from vlatool.files.printable import one_line
from vlatool.weights.shards import read_header

BUILD = (
    "name the network: a policy.yaml with source: policy.py:make (docs/guides/your-own-policy.md), a .pt2 or a .onnx"
)
CONVERT = "convert it: pip install tf2onnx; python -m tf2onnx.convert {option} {path} --output policy.onnx"
ORIGINAL = "name what it was made from: the ONNX file, the torch policy, or the checkpoint"
WRAP = "docs/guides/lerobot-policy.md and docs/guides/hugging-face-policy.md wrap checkpoints"
MAX_CONFIG_BYTES = 1 << 20


class Foreign(NamedTuple):
    """What something is.

    Args:
        what: with an article.
        remedy: what to do; ``{path}`` stands for its path.
    """

    what: str
    remedy: str


PICKLE = Foreign("a pickle, which may run any code when it is opened; it was not", BUILD)
KERAS = Foreign("a Keras model", CONVERT.replace("{option}", "--keras"))
TENSORRT = Foreign("an engine that TensorRT compiled for one card", ORIGINAL)
PADDLE = Foreign(
    "a Paddle model", "convert it: pip install paddle2onnx; paddle2onnx --model_dir DIR --save_file policy.onnx"
)
OPENVINO = Foreign("an OpenVINO IR, which nothing turns back into a graph that can be quantized", ORIGINAL)
CORE_ML = Foreign("a Core ML model", ORIGINAL)
RECORDING = Foreign("a recording and no policy", "name the policy; recordings go with --data and --calibration")
SUFFIXES = {
    ".safetensors": Foreign("a file of weights alone, without a network", BUILD),
    ".gguf": Foreign("a model of llama.cpp", ORIGINAL), ".ggml": Foreign("a model of llama.cpp", ORIGINAL),
    ".engine": TENSORRT, ".plan": TENSORRT, ".trt": TENSORRT,
    ".tflite": Foreign("a TensorFlow Lite model", CONVERT.replace("{option}", "--tflite")),
    ".h5": KERAS, ".keras": KERAS,
    ".pb": Foreign("a frozen TensorFlow graph", CONVERT.replace("{option}", "--graphdef")),
    ".pdmodel": PADDLE, ".pdiparams": PADDLE, ".xml": OPENVINO, ".bin": Foreign("weights without a network", BUILD),
    ".mlmodel": CORE_ML, ".mlpackage": CORE_ML, ".pte": Foreign("a program that ExecuTorch compiled", ORIGINAL),
    ".pkl": PICKLE, ".pickle": PICKLE, ".joblib": PICKLE,
    ".npz": RECORDING, ".hdf5": RECORDING, ".mcap": RECORDING, ".bag": RECORDING, ".parquet": RECORDING,
}  # fmt: skip
FOLDERS = {
    "saved_model.pb": Foreign("a TensorFlow SavedModel", CONVERT.replace("{option}", "--saved-model")),
    "adapter_config.json": Foreign(
        "an adapter (LoRA), which changes another model", "merge it into that model first (merge_and_unload of peft)"
    ),
    "model_index.json": Foreign("a pipeline of diffusers", f"{WRAP}; else {BUILD}"),
    "_METADATA": Foreign("a checkpoint of JAX (orbax), such as those of openpi", f"export it to torch first; {BUILD}"),
    "__model__": PADDLE, "inference.pdmodel": PADDLE,
}  # fmt: skip
"""A file that a directory holds -> what the directory is."""


def foreign(path: Path) -> Foreign | None:
    """Return what a file or directory is that no source reads; None for what is not known.

    Names are looked at, the header of a safetensors file, and the config.json of a checkpoint; nothing is opened that
    could run code.

    Raises:
        SourceError: when a safetensors file is damaged.
    """
    if path.suffix == ".safetensors" and path.is_file():
        read_header(path)
    found = SUFFIXES.get(path.suffix.lower()) if path.exists() else None
    if path.is_dir():
        if (name := foreign_format(path / "manifest.json")) is not None:
            return Foreign(f"a package of another tool, of the format '{one_line(name, 40)}'", ORIGINAL)
        found = next((about for name, about in FOLDERS.items() if (path / name).exists()), found) or _checkpoint(path)
    return found and Foreign(found.what, found.remedy.replace("{path}", str(path)))


def foreign_format(manifest: Path) -> str | None:
    """Return the ``format`` that a manifest.json names, which vlatool's own do not; None where it names none."""
    try:
        data = read_json(manifest.read_bytes(), str(manifest), SourceError, "") if _is_small(manifest) else None
    except (SourceError, OSError):
        return None
    return str(data["format"]) if isinstance(data, dict) and "format" in data else None


def _is_small(file: Path) -> bool:
    return file.is_file() and file.stat().st_size <= MAX_CONFIG_BYTES


def _checkpoint(path: Path) -> Foreign | None:
    """Return what a directory with weights and a config.json is: LeRobot names its policy, transformers its classes."""
    file = path / "config.json"
    weights = [each for each in path.iterdir() if each.name.endswith((".safetensors", ".bin"))]
    if not _is_small(file) or not weights:
        return None
    try:
        config = read_json(file.read_bytes(), str(file), SourceError, "")
    except (SourceError, OSError):
        config = None
    config = config if isinstance(config, dict) else {}
    if isinstance(kind := config.get("type"), str) and ("input_features" in config or "n_action_steps" in config):
        return Foreign(f"a LeRobot checkpoint of the policy '{one_line(kind, 40)}'", f"{WRAP}; else {BUILD}")
    if isinstance(kind := config.get("model_type"), str):
        return Foreign(f"a Hugging Face checkpoint of the model '{one_line(kind, 40)}'", f"{WRAP}; else {BUILD}")
    return Foreign("a checkpoint of another library", f"{WRAP}; else {BUILD}")
