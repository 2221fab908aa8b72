"""``vlatool inspect``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.bundle import Bundle, manifest_bytes
from vlatool.manifest import Manifest
from vlatool.printable import printable
from vlatool.spec import TensorSpec


def inspect(
    bundle: Annotated[Path, typer.Argument(help="a bundle", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="print the manifest as JSON")] = False,
) -> None:
    """Verify a bundle and say what is in it."""
    opened = Bundle.open(bundle)
    if as_json:
        typer.echo(manifest_bytes(opened.manifest).decode(), nl=False)
        return
    for line in describe(opened):
        typer.echo(printable(line))


def describe(bundle: Bundle) -> list[str]:
    """Return what a person wants to know about a bundle, a line each."""
    manifest = bundle.manifest
    lines = [
        f"{manifest.name} {manifest.version}  {bundle.hash[:19]}  {bundle.size_bytes / 1e6:.1f} MB, every file verified"
    ]
    if manifest.description:
        lines.append(f"  {manifest.description}")
    spec = manifest.spec
    rate = f"{spec.control_hz:g} Hz control, {spec.execute or spec.chunk} of {spec.chunk} actions executed"
    lines += [f"  rate       {rate}: {spec.inference_hz:g} inferences per second"]
    lines += [f"  input      {_tensor(tensor)}" for tensor in spec.inputs]
    lines += [f"  output     {_tensor(tensor)}" for tensor in spec.outputs]
    for name, graph in manifest.graphs.items():
        shares = ", ".join(f"{share:.1%} {kind}" for kind, share in graph.precision.items())
        size = manifest.files[graph.file].bytes / 1e6
        lines.append(f"  graph      {name}: {size:.2f} MB, opset {graph.opset}, MACs: {shares}")
    lines += _lineage(manifest)
    return lines


def _tensor(tensor: TensorSpec) -> str:
    shape = "x".join(str(axis) for axis in tensor.shape)
    unit = ",".join(dict.fromkeys(tensor.units())) if tensor.unit else ""
    rest = " ".join(
        part for part in (unit and f"[{unit}]", tensor.mode, tensor.normalisation.replace("none", "")) if part
    )
    labels = f" ({', '.join(tensor.labels)})" if tensor.labels else ""
    kind = "text -> " if tensor.kind == "text" else ""
    return f"{tensor.name}: {kind}{tensor.dtype} {shape}{labels} {rest}".rstrip()


def _lineage(manifest: Manifest) -> list[str]:
    made: dict[str, Any] = manifest.made_by
    options = " ".join(f"{key}={value}" for key, value in made.get("options", {}).items())
    versions = ", ".join(f"{key} {value}" for key, value in made.get("versions", {}).items())
    lines = [f"  made by    {made.get('stage', '?')} {options}".rstrip()]
    lines += [f"  with       vlatool {made.get('vlatool', '?')}{', ' + versions if versions else ''}"]
    lines += [f"  parent     {manifest.parent[:19]}"] if manifest.parent else []
    for name, found in manifest.accuracy.items():
        interval = f" ({found['low']:.4f} to {found['high']:.4f})" if found.get("low") is not None else ""
        lines.append(f"  accuracy   {name} {found['value']:.4f}{interval}, n = {found['samples']}")
    return lines
