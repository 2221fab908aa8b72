"""A LeRobot checkpoint as a policy directory: traced in the Python that has LeRobot, with its statistics as data."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from vlatool.bundle.prompt import Prompt
from vlatool.bundle.spec import UNKNOWN
from vlatool.errors import SourceError
from vlatool.files.blob_store import mark_cache
from vlatool.files.directory_writer import write_directory
from vlatool.files.printable import truncate
from vlatool.machine.host import LEROBOT_PYTHON, cache_directory
from vlatool.module.description import FILE
from vlatool.sources._lerobot_checkpoint import Checkpoint, Feature, read_checkpoint
from vlatool.stage.base import content_hash

CHILD = Path(__file__).with_name("_lerobot_child.py")
TIMEOUT_S = 3600
POLICY = '''"""The graphs of a LeRobot checkpoint, traced by LeRobot; policy.yaml says how they are run."""

from pathlib import Path

import torch

FOLDER = Path(__file__).parent

{classes}

def make():
    """Return the modules of the policy, each with the weights of the checkpoint."""
    return {{{modules}}}
'''
GRAPH = """
class {title}(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.traced = torch.export.load(FOLDER / "{name}.pt2").module()

    def forward(self, {inputs}):
        return self.traced({inputs})

"""


def converted_checkpoint(folder: Path) -> Path:
    """Return the policy directory of a checkpoint in the cache, which is made when it is not there.

    Raises:
        SourceError: see ``LerobotCheckpoint.describe``.
    """
    checkpoint = read_checkpoint(folder)
    python = lerobot_python()
    content = [content_hash(folder), content_hash(CHILD), content_hash(Path(__file__)), python]
    cache = cache_directory()
    out = cache / "converted" / f"lerobot-{hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]}"
    if not (out / FILE).is_file():
        mark_cache(cache)
        with write_directory(out, damaged=True) as draft:
            write_policy(checkpoint, python, draft)
    return out


def lerobot_python() -> str:
    """Return the Python that has LeRobot: ``VLATOOL_LEROBOT_PYTHON``, or this one where LeRobot is installed.

    Raises:
        SourceError: when there is none.
    """
    named = os.environ.get(LEROBOT_PYTHON)
    if named and not (os.path.isfile(named) and os.access(named, os.X_OK)):
        raise SourceError(
            f"--python (or {LEROBOT_PYTHON}) names '{named}', which is not a program.", "name a python that has lerobot"
        )
    if not named and find_spec("lerobot") is None:
        raise SourceError(
            "A LeRobot checkpoint is traced by LeRobot itself, which is not installed beside vlatool.",
            f"name the Python that has it, which needs no vlatool: --python ~/lerobot/bin/python, or {LEROBOT_PYTHON}",
        )
    return named or sys.executable


def write_policy(checkpoint: Checkpoint, python: str, out: Path) -> None:
    """Write policy.yaml, policy.py, statistics.json and the traced graphs of a checkpoint into an empty directory.

    Raises:
        SourceError: when LeRobot cannot load or trace the policy.
    """
    facts = _traced(checkpoint, python, out)
    _check_prompts(checkpoint, facts)
    statistics = {feature.key: _rows(feature) for feature in (*checkpoint.inputs.values(), checkpoint.action)}
    (out / "statistics.json").write_text(
        json.dumps({key: rows for key, rows in statistics.items() if rows}, indent=1) + "\n", encoding="utf-8"
    )
    (out / "policy.py").write_text(_code(facts), encoding="utf-8")
    described = _description(checkpoint, facts)
    (out / FILE).write_text(yaml.safe_dump(described, sort_keys=False, width=120), encoding="utf-8")


def _traced(checkpoint: Checkpoint, python: str, out: Path) -> dict[str, Any]:
    """Trace the policy in a child, and return what it says of the graphs."""
    pictures = {
        key: {"mean": mean.tolist(), "scale": scale.tolist()}
        for key, feature in checkpoint.inputs.items()
        if feature.kind == "VISUAL" and feature.mode != "IDENTITY"
        for mean, scale in [_offset_and_scale(feature)]
    }
    request = out / "request.json"
    request.write_text(
        json.dumps({"checkpoint": str(checkpoint.folder.resolve()), "out": str(out), "pictures": pictures})
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    offline = {"HF_HUB_OFFLINE": "1", "TRANSFORMERS_OFFLINE": "1"}
    command = [python, "-I", str(CHILD), str(request)]
    try:
        ended = subprocess.run(
            command, env={**environment, **offline}, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SourceError(f"{python} did not trace {checkpoint.folder}: {error}", f"check {LEROBOT_PYTHON}") from error
    facts = out / "facts.json"
    if ended.returncode or not facts.is_file():
        last = next((line for line in reversed(ended.stderr.splitlines()) if line.strip()), f"exit {ended.returncode}")
        fix = "see whether LeRobot loads it there: from_pretrained(DIRECTORY)"
        if "No module named" in last:
            fix = f"name the Python that LeRobot is installed in, with --python; {python} lacks that module"
        raise SourceError(
            f"LeRobot cannot trace the policy in {checkpoint.folder}: {truncate(last.strip(), 300)}.",
            f"{fix}; extras of LeRobot may be missing (lerobot[diffusion], lerobot[smolvla])",
        )
    said: dict[str, Any] = json.loads(facts.read_text(encoding="utf-8"))
    request.unlink()
    facts.unlink()
    return said


def _check_prompts(checkpoint: Checkpoint, facts: Mapping[str, Any]) -> None:
    """Compare the prompts of this LeRobot with those of the spec: releases of it differ.

    Raises:
        SourceError: when one differs.
    """
    prompt = Prompt.from_dict(checkpoint.prompt)
    for task, state, lerobot in facts["prompts"]:
        if (own := prompt.write(task, np.array(state, np.float32))) != lerobot:
            raise SourceError(
                f"LeRobot {facts['versions']['lerobot']} makes another prompt of {task!r} than is known of 0.6: "
                f"{truncate(repr(lerobot), 200)}, not {truncate(repr(own), 200)}.",
                "name the Python that has LeRobot 0.6 with --python, if the policy was trained with it",
            )


def _offset_and_scale(feature: Feature) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what LeRobot subtracts from a feature, and what it divides by then."""
    first, second = feature.statistics.values()
    if feature.mode == "MEAN_STD":
        return first, second + feature.epsilon
    spread = np.where(second == first, feature.epsilon, second - first) / 2
    return first + spread, spread


def _rows(feature: Feature) -> dict[str, list[float]]:
    """Return the statistics of a vector for the spec; none for what is not normalised, or inside of the graph."""
    named = {} if feature.kind == "VISUAL" else feature.statistics
    return {name: values.tolist() for name, values in named.items()}


def _code(facts: Mapping[str, Any]) -> str:
    """Return policy.py, which opens the traced graphs; nothing that the checkpoint says becomes code."""
    graphs = facts["graphs"]
    classes = "".join(
        GRAPH.format(title=name.title(), name=name, inputs=", ".join(about["inputs"])) for name, about in graphs.items()
    )
    modules = ", ".join(f'"{name}": {name.title()}()' for name in graphs)
    return POLICY.format(classes=classes, modules=modules)


def _description(checkpoint: Checkpoint, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of policy.yaml; units and modes, which a checkpoint does not say, are left out."""
    history = {"history": facts["history"]} if facts["history"] > 1 else {}
    inputs = [
        {"name": feature.key, "shape": facts["shapes"][key], **history, **_tensor(feature)}
        for key, feature in checkpoint.inputs.items()
    ]
    if facts["tokens"]:
        prompt = {"prompt": dict(checkpoint.prompt)} if checkpoint.prompt else {}
        text = {"name": "task", "kind": "text", "tokenizer": "tokenizer.json", "max_tokens": facts["tokens"]}
        inputs.append({**text, **prompt})
    action = {"name": "action", "shape": facts["action"], **_tensor(checkpoint.action)}
    keys = {key: feature.key for key, feature in checkpoint.inputs.items()}
    program = [
        {**step, "feeds": {name: keys.get(value, value) for name, value in step["feeds"].items()}}
        for step in facts["program"]
    ]
    name = checkpoint.folder.resolve().name
    return {
        "schema": 1,
        "name": checkpoint.family if name in ("pretrained_model", "") else name,
        "description": f"LeRobot {checkpoint.family}, traced by LeRobot {facts['versions']['lerobot']}. The checkpoint "
        f"says neither units nor modes nor the control rate.{_how_to_play(checkpoint)}",
        "source": "policy.py:make",
        "spec": {
            "inputs": inputs,
            "outputs": [action],
            "control_hz": UNKNOWN,
            "chunk": facts["chunk"],
            "execute": min(checkpoint.execute, facts["chunk"]),
        },
        "program": program,
    }


def _how_to_play(checkpoint: Checkpoint) -> str:
    """Return which controller does what LeRobot does with the chunks, where that is not the usual one."""
    if checkpoint.ensemble is None:
        return ""
    return f" It averages its chunks: --controller temporal_ensemble:coefficient={checkpoint.ensemble:g}."


def _tensor(feature: Feature) -> dict[str, Any]:
    if feature.kind == "VISUAL":
        return {"dtype": "uint8", "unit": "rgb"}
    said = {"labels": list(feature.labels), "convert": list(feature.convert)}
    more = {name: value for name, value in said.items() if value}
    if any(step["op"] == "relative" for step in feature.convert):
        more["mode"] = "absolute"  # what is relative in the network is a target once the state is added
    if feature.mode == "IDENTITY":
        return {"dtype": "float32", **more}
    how = {"normalisation": feature.mode.lower(), "epsilon": feature.epsilon}  # a spec calls the modes as LeRobot does
    return {"dtype": "float32", **how, "statistics": f"statistics.json#{feature.key}", **more}
