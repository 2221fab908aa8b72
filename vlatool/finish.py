"""The last steps of every stage that makes a bundle: carry over what stays, golden inputs and outputs, hashes."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle import Bundle, seal
from vlatool.manifest import FileRecord, Graph, Manifest
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import draw

GOLDEN = "golden/golden.npz"
GOLDEN_COUNT = 2
SEED = 0
"""Seed of the noise that golden inputs and calibration runs draw."""
CARRIED = ("assets", "data")
HANDED_OUT = "optimize"
"""In a build record, the entry of the step in which ``optimize`` hands a candidate out."""
DECIDED = ("accuracy", "engine")
"""Fields of a manifest that ``optimize`` sets when it hands a candidate out."""


def carry_over(source: Bundle, out: Path, folders: Iterable[str] = CARRIED) -> None:
    """Copy the folders that a derived bundle keeps."""
    for folder in folders:
        for file in sorted((source.path / folder).rglob("*")):
            if file.is_file():
                target = out / file.relative_to(source.path)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)


def finish(
    source: Bundle,
    out: Path,
    *,
    made_by: Mapping[str, Any],
    graphs: Mapping[str, Graph],
    observations: list[dict[str, Any]],
    changes: Mapping[str, Any] | None = None,
) -> Bundle:
    """Write golden file and manifest of a bundle whose graphs and carried folders are in ``out`` already.

    Args:
        source: What the bundle was made from.
        made_by: Stage, options and versions.
        graphs: Graph name -> graph.
        observations: Raw observations; the first two become golden.
        changes: Other fields of the manifest that the stage changes, such as program and engine.

    Raises:
        GraphError: when the engine refuses a graph or gives an action that is not finite.
    """
    changed: dict[str, Any] = {"parent": source.hash, "made_by": dict(made_by), "graphs": dict(graphs), "accuracy": {}}
    changed.update(changes or {})
    origin = {key: value for key, value in source.manifest.source.items() if key != "arguments"}
    unhashed = {graph.file: FileRecord("", 0) for graph in graphs.values()}
    draft = seal(out, replace(source.manifest, golden="", source=origin, files=unhashed, **changed))
    write_golden(draft, observations, out)
    return seal(out, replace(draft.manifest, golden=GOLDEN, build=(*history(source), _step(source, draft.manifest))))


def history(bundle: Bundle) -> tuple[dict[str, Any], ...]:
    """Return the build record of a bundle: one entry for each stage from the source to this bundle.

    A source bundle has no ``build`` of its own, and ``optimize`` hands a bundle out without a stage; their entries are
    what their manifests say. A bundle from before there was a record has an incomplete one, or none.
    """
    manifest = bundle.manifest
    made, recorded = manifest.made_by, manifest.build
    if not recorded and str(made.get("stage", "")).startswith("sources."):
        recorded = ({**made, "factory": manifest.source.get("factory", "")},)
    if "candidate" not in made or (recorded and recorded[-1]["stage"] == HANDED_OUT):
        return recorded
    options = {name: made[name] for name in ("candidate", "profile") if name in made}
    handed = {"vlatool": made.get("vlatool", ""), "stage": HANDED_OUT, "options": options, "input": manifest.parent}
    decided = {name: getattr(manifest, name) for name in DECIDED if getattr(manifest, name)}
    return (*recorded, {**handed, **decided})


def _step(source: Bundle, draft: Manifest) -> dict[str, Any]:
    """Return the entry of the stage that made ``draft`` from ``source``."""
    starts = str(draft.made_by.get("stage", "")).startswith("sources.")
    graphs = {name: record.sha256 for name, record in draft.files.items() if name.startswith("graphs/")}
    seed = draft.made_by.get("seed", SEED)
    return {**draft.made_by, "seed": seed, "input": "" if starts else source.hash, "graphs": graphs}


def reseal(bundle: Bundle, out: Path, manifest: Manifest, folders: Iterable[str]) -> Bundle:
    """Copy folders of a bundle to ``out`` and seal it there under another manifest."""
    carry_over(bundle, out, folders)
    return seal(out, manifest)


def write_golden(draft: Bundle, observations: list[dict[str, Any]], out: Path) -> None:
    """Run the first observations and store ``in.NAME``, ``noise.NAME``, ``out.NAME`` and ``chunk.NAME``.

    Each has a sample axis. They follow each other without a reset between, so that what a program keeps shows in the
    second. The chunk is the action in physical units: it shows other statistics, too.

    Args:
        draft: The bundle as written so far; its graphs are what runs.
        observations: Raw observations without the batch axis.
        out: The bundle's directory.
    """
    policy = Policy.open(draft, threads=1, seed=SEED)
    random = np.random.default_rng(SEED)
    arrays: dict[str, list[Any]] = {}
    for observation in (observations * GOLDEN_COUNT)[:GOLDEN_COUNT]:
        noise = {name: draw(wanted, random) for step in draft.manifest.program for name, wanted in step.noise.items()}
        action = policy.infer(observation, noise=noise)
        chunk = {draft.manifest.spec.action.name: action.chunk}
        for prefix, values in (("in", observation), ("noise", noise), ("out", action.outputs), ("chunk", chunk)):
            for name, value in values.items():
                arrays.setdefault(f"{prefix}.{name}", []).append(value)
    (out / GOLDEN).parent.mkdir(exist_ok=True)
    save_npz(out / GOLDEN, {name: np.stack([np.asarray(item) for item in items]) for name, items in arrays.items()})


def save_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as ``.npz`` with fixed time stamps, so that equal arrays give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
