"""An OpenVLA checkpoint of 7.5 billion parameters becomes int4; prints the peak of resident memory.

    python tests/validation/soak/openvla_memory.py FOLDER [-o out/int4]

Makes FOLDER as openvla/openvla-7b is laid out, in bfloat16: shards of the real sizes whose tensors begin with random
numbers and are zeros that take no place on the disk after a mebibyte. Then runs ``vlatool quantize weight-only FOLDER
--bits 4`` and adds up the largest VmHWM of each of its processes. Exits 1 when that is above 3 GB.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from _openvla import CONFIG, PICTURES, TOKENIZER, Shapes, llama, projector, tower

LIMIT_GB = 3.0
DENSE_BYTES = 1 << 20
SHARD_BYTES = 5 << 30
VOCABULARY, PAD, SIDE = 32064, 32000, 224


def all_shapes() -> Shapes:
    """Return the shapes of the tensors of openvla/openvla-7b."""
    shapes = tower("featurizer", 1024, 4096, registers=4, scale="scale_factor", blocks=24, patch=14, grid=16)
    shapes |= tower("fused_featurizer", 1152, 4304, registers=0, scale="", blocks=27, patch=14, grid=16)
    return {**shapes, **projector(2176, 8704, 4096, 4096), **llama(VOCABULARY, 4096, 11008, keys=4096, layers=32)}


def write(folder: Path) -> int:
    """Write the checkpoint; return the number of parameters."""
    folder.mkdir(parents=True)
    config = copy.deepcopy(CONFIG)
    config |= {"image_sizes": [SIDE, SIDE], "pad_token_id": PAD}
    config["text_config"] = {"model_type": "llama", "vocab_size": VOCABULARY, "pad_token_id": PAD}
    for name, content in (
        ("config.json", config), ("preprocessor_config.json", PICTURES), ("tokenizer.json", TOKENIZER)
    ):  # fmt: skip
        (folder / name).write_text(json.dumps(content))
    shards: list[Shapes] = [{}]
    size = 0
    for name, shape in all_shapes().items():
        if size > SHARD_BYTES:
            shards.append({})
            size = 0
        shards[-1][name] = shape
        size += 2 * math.prod(shape)
    files = [f"model-{number:05}-of-{len(shards):05}.safetensors" for number in range(1, len(shards) + 1)]
    for file, shapes in zip(files, shards, strict=True):
        _write_shard(folder / file, shapes)
    index = {"weight_map": {name: file for file, shapes in zip(files, shards, strict=True) for name in shapes}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    return sum(math.prod(shape) for shape in all_shapes().values())


def _write_shard(file: Path, shapes: Shapes) -> None:
    drawn, offset, header = np.random.default_rng(0), 0, {}
    for name, shape in shapes.items():
        nbytes = 2 * math.prod(shape)
        header[name] = {"dtype": "BF16", "shape": list(shape), "data_offsets": [offset, offset + nbytes]}
        offset += nbytes
    text = json.dumps(header).encode()
    with file.open("wb") as stream:
        stream.write(len(text).to_bytes(8, "little") + text)
        for entry in header.values():
            begin, end = entry["data_offsets"]
            values = drawn.normal(0, 0.02, min(end - begin, DENSE_BYTES) // 2).astype(np.float32)
            stream.seek(8 + len(text) + begin)
            stream.write((values.view(np.uint32) >> 16).astype(np.uint16).tobytes())
        stream.truncate(8 + len(text) + offset)


def peak_gb(command: list[str]) -> tuple[float, int]:
    """Run a command; return the sum of the largest VmHWM of its processes in GB, and its exit code."""
    peaks: dict[int, int] = {}
    process = subprocess.Popen(command)
    while process.poll() is None:
        for pid in _descendants(process.pid):
            peaks[pid] = max(peaks.get(pid, 0), _high_water(pid))
        time.sleep(0.25)
    return sum(peaks.values()) / 1e9, process.returncode


def _descendants(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return [pid]
    return [pid, *(found for child in children for found in _descendants(int(child)))]


def _high_water(pid: int) -> int:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


def main(arguments: list[str]) -> int:
    """Make the checkpoint where there is none, and quantize it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/openvla-int4"))
    asked = parser.parse_args(arguments)
    if not asked.folder.is_dir():
        print(f"{write(asked.folder) / 1e9:.2f} billion parameters", flush=True)
    command = [sys.executable, "-m", "vlatool", "quantize", "weight-only", str(asked.folder)]
    started = time.monotonic()
    peak, code = peak_gb([*command, "--bits", "4", "--block", "32", "-o", str(asked.output)])
    written = sum(file.stat().st_size for file in asked.output.rglob("*") if file.is_file()) / 1e9 if not code else 0
    print(f"exit {code}, {time.monotonic() - started:.0f} s, {written:.2f} GB written, {peak:.2f} GB resident at most")
    return int(bool(code) or peak > LIMIT_GB)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
