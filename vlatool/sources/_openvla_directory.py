"""An OpenVLA checkpoint as a policy directory: its weights stay in its shards, to which the directory has links."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import yaml

from vlatool.bundle.spec import UNKNOWN
from vlatool.errors import require
from vlatool.files.blob_store import mark_cache
from vlatool.files.directory_writer import write_directory
from vlatool.files.printable import one_line
from vlatool.machine.host import UNNORM_KEY, cache_directory
from vlatool.module.description import FILE, MAX_LABEL_CHARACTERS
from vlatool.sources._openvla_checkpoint import INSTRUCTION, SHARDS, Checkpoint, check_tensors, read_checkpoint
from vlatool.weights.shards import INDEX, fingerprint, shard_files

FACTORY = "vlatool.sources._openvla_network:make"
PROMPT_TOKENS = 64
"""Ids of a prompt, of which the question around the instruction takes 20."""
CACHE = ("keys", "values")


def converted_checkpoint(folder: Path) -> Path:
    """Return the policy directory of a checkpoint in the cache, which is made when it is not there.

    Raises:
        SourceError: see ``read_checkpoint``.
    """
    checkpoint = read_checkpoint(folder, os.environ.get(UNNORM_KEY, ""), PROMPT_TOKENS)
    described, shards = _description(checkpoint), shard_files(folder, SHARDS)
    content = [described, checkpoint.statistics, checkpoint.tokenizer, str(folder.resolve()), fingerprint(shards)]
    cache = cache_directory()
    out = cache / "converted" / f"openvla-{hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]}"
    if not (out / FILE).is_file():
        check_tensors(checkpoint, _network_shapes(checkpoint))
        mark_cache(cache)
        with write_directory(out, damaged=True) as draft:
            for file in (*shards, *folder.glob(f"*{INDEX}")):
                (draft / file.name).symlink_to(file.resolve())
            _write(draft, described, checkpoint)
    return out


def _network_shapes(checkpoint: Checkpoint) -> dict[str, tuple[int, ...]]:
    """Return name -> shape of each weight of the network, which is built without memory for it."""
    torch = require("torch", "build")
    from vlatool.sources._openvla_network import make

    with torch.device("meta"):
        graphs = make(**checkpoint.arguments)
    shapes = {name: tuple(value.shape) for graph in graphs.values() for name, value in graph.state_dict().items()}
    if checkpoint.arguments["language"]["tied"]:
        del shapes["language_model.lm_head.weight"]
    return shapes


def _write(out: Path, described: dict[str, Any], checkpoint: Checkpoint) -> None:
    statistics = json.dumps({"action": checkpoint.statistics}, indent=1)
    (out / "statistics.json").write_text(f"{statistics}\n", encoding="utf-8")
    (out / "tokenizer.json").write_text(checkpoint.tokenizer, encoding="utf-8")
    (out / FILE).write_text(yaml.safe_dump(described, sort_keys=False, width=120), encoding="utf-8")


def _description(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return the content of policy.yaml; units, modes and rate, which a checkpoint does not say, are left out."""
    decoding = checkpoint.arguments["decoding"]
    name = one_line(checkpoint.folder.resolve().name, MAX_LABEL_CHARACTERS) or "openvla"
    return {
        "schema": 1,
        "name": name,
        "description": f"OpenVLA, greedy; actions in the statistics of {checkpoint.dataset}. The checkpoint says "
        "neither units nor modes nor the control rate.",
        "source": FACTORY,
        "arguments": checkpoint.arguments,
        "weights": SHARDS,
        "spec": {
            "inputs": [_image(checkpoint), _text(checkpoint)],
            "outputs": [
                {
                    "name": "action", "shape": [1, decoding["actions"]], "normalisation": "quantiles",
                    "statistics": "statistics.json#action", "epsilon": 1e-8,
                },
                {"name": "tokens", "shape": [1, decoding["actions"]], "dtype": "int64"},
            ],
            "control_hz": UNKNOWN,
        },
        "program": _program(decoding["actions"]),
    }  # fmt: skip


def _image(checkpoint: Checkpoint) -> dict[str, Any]:
    size = [checkpoint.image, checkpoint.image]
    resize = {"op": "resize", "size": size, "filter": checkpoint.filter, "fit": checkpoint.fit}
    crop = [{"op": "crop", "size": size}] if checkpoint.fit == "cover" else []
    return {"name": "image", "shape": [1, 3, *size], "dtype": "uint8", "image": {"steps": [resize, *crop]}}


def _text(checkpoint: Checkpoint) -> dict[str, Any]:
    prompt = {"template": checkpoint.prompt.template, "lower": checkpoint.prompt.lower, "last": checkpoint.prompt.last}
    tokens = checkpoint.arguments["decoding"]["prompt_tokens"]
    return {
        "name": INSTRUCTION, "kind": "text", "tokenizer": "tokenizer.json", "max_tokens": tokens, "prompt": prompt
    }  # fmt: skip


def _program(actions: int) -> list[dict[str, Any]]:
    """Return how the graphs run: picture, prompt and first token, then each further token."""
    after = (*CACHE, "tokens")
    given = (*CACHE, "start", "tokens", "action")
    program: list[dict[str, Any]] = [
        {"graph": "vision", "feeds": {"image": "image"}, "gives": {"patches": "patches"}},
        {
            "graph": "prefill", "feeds": {"patches": "patches", "ids": INSTRUCTION},
            "gives": {name: name for name in given},
        },
        {
            "graph": "decode", "feeds": {name: name for name in ("number", *CACHE, "start", "tokens")},
            "gives": {**{f"next_{name}": f"next_{name}" for name in after}, "next_action": "action"},
            "repeat": actions - 1, "carry": {f"next_{name}": name for name in after},
            "schedule": {"number": list(range(1, actions))},
        },
    ]  # fmt: skip
    return program if actions > 1 else program[:2]
