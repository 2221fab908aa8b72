"""Write the directory of a sample policy: description, vocabulary and recorded observations; needs no torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from vlatool import registry
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import require
from vlatool.samples._observations import observations
from vlatool.samples._words import vocabulary

COUNTS = {"calibration": 48, "evaluation": 12}


def write_sample(name: str, out: Path, seed: int = 0) -> None:
    """Write ``policy.yaml``, ``calibration.npz``, ``evaluation.npz`` and, for a policy that reads, ``vocabulary.json``.

    Args:
        name: A sample, with dashes or underscores: ``vit-s``.
        out: Fresh, writable directory.

    Raises:
        UsageError: when there is no such sample.
        MissingExtra: when PyYAML is absent.

    Example:
        >>> write_sample("vit-s", Path("vit-s"))  # doctest: +SKIP
    """
    module = registry.module("samples", name)
    spec = PolicySpec.from_dict(module.SPEC)
    key = module.__name__.rpartition(".")[2]
    _write_description(
        out / "policy.yaml", key, seed, module.DESCRIPTION, module.SPEC, getattr(module, "PROGRAM", None)
    )
    if any(tensor.kind == "text" for tensor in spec.inputs):
        text = json.dumps(vocabulary(), indent=1) + "\n"
        (out / "vocabulary.json").write_text(text, encoding="utf-8")
    for number, (part, count) in enumerate(COUNTS.items()):
        random = np.random.default_rng([seed, number])
        recorded = observations(spec, getattr(module, "RANGES", {}), count, random)
        np.savez_compressed(out / f"{part}.npz", allow_pickle=False, **recorded)


def _write_description(
    file: Path, key: str, seed: int, description: str, spec: dict[str, object], program: list[dict[str, object]] | None
) -> None:
    content: dict[str, Any] = {
        "schema": 1,
        "name": key.replace("_", "-"),
        "version": "0.0.0",
        "description": description,
        "source": f"vlatool.samples.{key}:make",
        "arguments": {"seed": seed},
        "spec": spec,
    }
    if program is not None:
        content["program"] = program
    text = require("yaml", "build").safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    file.write_text(text, encoding="utf-8")
