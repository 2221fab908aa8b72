"""``vlatool inspect``."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.bundle.bundle import Bundle, manifest_bytes
from vlatool.bundle.conversion import describe_conversion
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import UNKNOWN, TensorSpec
from vlatool.cli._console import progress
from vlatool.cli._document import document
from vlatool.cli._frame import describe_image, show_frame
from vlatool.cli._options import BundlePath, Force
from vlatool.cli._proposal import propose
from vlatool.errors import BundleError, GraphError, SpecError, UsageError
from vlatool.files.printable import printable
from vlatool.files.verified_read import open_inside
from vlatool.module.source import is_bundle
from vlatool.module.stage import describe_modules
from vlatool.runtime.external_data import OpenFile, external_files
from vlatool.runtime.graph_files import recorded_files
from vlatool.runtime.identity import policy_identity
from vlatool.runtime.policy import FIRST_RUN_S
from vlatool.runtime.probe import probe as try_once
from vlatool.stage.controls import controls

MAX_OPTION = 120
"""Characters of an option of a build record that are shown."""
MAX_INFLUENCES = 24
"""Influences of --sensitivity that are shown in the terminal."""


def inspect(
    bundle: BundlePath,
    as_json: Annotated[bool, typer.Option("--json", help="print the manifest as JSON")] = False,
    probe: Annotated[
        bool,
        typer.Option(
            "--probe", help="also run it once, in a child process with limits; exits with 3 if load would refuse it"
        ),
    ] = False,
    first_run: Annotated[
        float, typer.Option("--first-run", min=0.1, help="seconds that the run of --probe may take")
    ] = FIRST_RUN_S,
    memory: Annotated[
        float | None,
        typer.Option("--memory", min=1, help="MB that --probe may take; 2,000 and 8 times the graphs when not given"),
    ] = None,
    sensitivity: Annotated[
        bool,
        typer.Option("--sensitivity", help="also show which element of an input moves which element of the action"),
    ] = False,
    samples: Annotated[int, typer.Option(min=1, max=1000, help="recorded observations for --sensitivity")] = 8,
    frame: Annotated[
        str,
        typer.Option(
            "--frame",
            metavar="[INPUT=]FILE",
            help="show what the network sees of a camera frame: a picture, or .npy as the camera gives it",
        ),
    ] = "",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="PNG of --frame with what the network sees beside it")
    ] = None,
    force: Force = False,
) -> None:
    """Verify a bundle and show what is in it; of a policy, what its bundle would hold."""
    if (output and not frame) or (as_json and frame):
        wrong = "--json prints the manifest alone, and --frame" if frame else "--output is of --frame, which"
        raise UsageError(f"{wrong} is {'given' if frame else 'missing'}.", "leave one of them out")
    opened = _opened(bundle)
    tried = try_once(opened.path, first_run_s=first_run, memory_mb=memory) if probe else None
    moves = _sensitivity(opened, samples) if sensitivity else None
    if as_json and moves is not None:
        document(moves)
    elif as_json:
        document(opened.manifest.to_dict(), manifest_bytes(opened.manifest).decode())
    else:
        shown = show_frame(opened, frame, output, force=force) if frame else []
        shards = () if opened.manifest.graphs or is_bundle(bundle) else describe_modules(opened)
        for line in [
            *describe(opened),
            *shards,
            *shown,
            *([] if tried is None else [_probed(tried)]),
            *_influences(moves),
        ]:
            typer.echo(printable(line))
    if tried is not None and tried["refused"]:
        raise GraphError(*tried["refused"])


def _sensitivity(bundle: Bundle, samples: int) -> dict[str, Any]:
    from vlatool.verify.influence import sensitivity

    with progress() as context:
        context.progress("moving each input", None)
        return sensitivity(bundle, samples)


def _influences(moves: Mapping[str, Any] | None) -> list[str]:
    """Return the largest influences, a line each."""
    if moves is None:
        return []
    kind = "recorded" if moves["recorded"] else "random"
    lines = [f"  moves      on {moves['samples']} {kind} observations; input -> action: slope; effect in spreads; sign"]
    for each in moves["influences"][:MAX_INFLUENCES]:
        what = f"{each['input']} -> {each['output']}"
        slope = f"{each['slope']:+.3g} {each['unit']}"
        lines.append(f"    {what:32} {slope:>20} {each['effect']:+8.3f}  {each['agreement']:.0%} of the same sign")
    rest = len(moves["influences"]) - MAX_INFLUENCES
    lines += [f"    and {rest} smaller ones: --json shows all"] if rest > 0 else []
    lines += [f"    not moved: {', '.join(moves['left_out'])}"] if moves["left_out"] else []
    return lines


def _opened(named: Path) -> Bundle:
    """Open a bundle, or that of a policy, exported with the default options unless it is larger than memory may be."""
    from vlatool.cli._run import open_with_graphs
    from vlatool.module.source import claimed_source
    from vlatool.sources import has_large_shards, source_bundle
    from vlatool.stage.run import cache_directory

    if is_bundle(named) or (source := claimed_source(named)) is None:
        return Bundle.open(named)
    with progress() as context:
        if has_large_shards(source):
            opened = source_bundle(source.trust_code(), cache_directory(), context).bundle
        else:
            opened = open_with_graphs(str(named), context)
    propose(str(named), opened.manifest, None)
    return opened


def _probed(tried: Mapping[str, Any]) -> str:
    """Return a line on the run of ``--probe``: each error of the golden action beside the one that is allowed."""
    errors = zip(
        (tried["golden_error"], tried["golden_chunk_error"]), tried["golden_tolerances"],
        ("golden error", "in physical units"), strict=True,
    )  # fmt: skip
    parts = [f"{name} {error:.2g} (allowed {allowed:g})" for error, allowed, name in errors if error is not None]
    used = f"{tried['peak_rss_mb']:,.0f} MB resident, {tried['memory_mb']:,.0f} MB allowed"
    return f"  probe      ran once: {', '.join([*(parts or ['no golden action']), used])}"


def describe(bundle: Bundle) -> list[str]:
    """Return what a person wants to know about a bundle, a line each."""
    manifest = bundle.manifest
    lines = [
        f"{manifest.name} {manifest.version}  {bundle.hash[:19]}  {bundle.size_bytes / 1e6:.1f} MB, every file verified"
    ]
    if manifest.description:
        lines.append(f"  {manifest.description}")
    spec = manifest.spec
    lines += [f"  policy     {_identity(bundle)}"]
    executed = f"{spec.execute or spec.chunk} of {spec.chunk} actions executed"
    known = spec.control_hz is not None
    ends = f": {spec.inference_hz:g} inferences per second" if known else ""
    rate = f"{spec.control_hz:g} Hz control" if known else f"control at an {UNKNOWN} rate"
    lines += [f"  rate       {rate}, {executed}{ends}"]
    lines += [f"  unknown    {', '.join(spec.unknown())}"] if spec.unknown() else []
    for side, tensors in (("input ", spec.inputs), ("output", spec.outputs)):
        for tensor in tensors:
            lines += [f"  {side}     {_tensor(tensor)}", *_conventions(tensor)]
    for name, graph in manifest.graphs.items():
        shares = ", ".join(f"{share:.1%} {kind}" for kind, share in graph.precision.items())
        size = _megabytes(bundle, graph.file) + "".join(
            f" + {_megabytes(bundle, file)} in {file}" for file in _beside(bundle, graph.file)
        )
        lines.append(f"  graph      {name}: {size}, opset {graph.opset}, MACs: {shares}")
    lines += _lineage(manifest)
    lines += [f"  WRONG      {finding['name']}: {finding['message']}" for finding in manifest.findings]
    lines += [f"  CONTROL    {line}" for line in controls(bundle)]
    return lines


def _identity(bundle: Bundle) -> str:
    """Return the identity of the policy in a bundle, or why it has none."""
    try:
        return policy_identity(bundle)
    except (BundleError, GraphError, SpecError) as error:
        return f"no identity: {error.message}"


def _beside(bundle: Bundle, file: str) -> list[str]:
    """Return the files of a bundle in which a graph keeps weights; graphs may share one. None of a broken graph."""
    with contextlib.suppress(BundleError, GraphError), open_inside(bundle.path, file) as handle:
        return recorded_files(bundle, file, external_files(OpenFile(handle)))
    return []


def _megabytes(bundle: Bundle, file: str) -> str:
    return f"{bundle.manifest.files[file].bytes / 1e6:.2f} MB"


def _units(units: tuple[str, ...]) -> str:
    """Return the units of the elements in their order; what repeats is counted, and one that all have named once."""
    if len(set(units)) == 1:
        return units[0]
    runs = [(unit, len(list(same))) for unit, same in itertools.groupby(units)]
    return ", ".join(f"{unit or '-'} x{count}" if count > 1 else unit or "-" for unit, count in runs)


def _tensor(tensor: TensorSpec) -> str:
    shape = "x".join(str(axis) for axis in tensor.shape)
    unit = _units(tensor.units()) if tensor.unit else ""
    rest = " ".join(
        part
        for part in (
            unit and f"[{unit}]",
            tensor.mode,
            tensor.normalisation.replace("none", ""),
            "" if tensor.finite else "takes NaN and infinity",
            f"of {describe_image(tensor.image)}" if tensor.image else "",
            f"the last {tensor.history} moments" if tensor.history else "",
        )
        if part
    )
    labels = f" ({', '.join(tensor.labels)})" if tensor.labels else ""
    kind = "text -> " if tensor.kind == "text" else ""
    return f"{tensor.name}: {kind}{tensor.dtype} {shape}{labels} {rest}".rstrip()


def _conventions(tensor: TensorSpec) -> list[str]:
    """Return the parts of a vector, and what lies between the robot and the network, a line each."""
    parts = [f"{name} [{start}, {stop})" for name, (start, stop) in tensor.parts.items()]
    lines = [f"    parts    {', '.join(parts)}"] if parts else []
    return lines + [f"    convert  {describe_conversion(step)}" for step in tensor.convert]


def _short(value: str) -> str:
    """Return a value, of a long one its beginning: what a stage chose may be a list of thousands of units."""
    return value if len(value) <= MAX_OPTION else f"{value[: MAX_OPTION - 20]}… ({len(value)} characters)"


def _lineage(manifest: Manifest) -> list[str]:
    made_by: dict[str, Any] = manifest.made_by
    options = " ".join(f"{key}={_short(str(value))}" for key, value in made_by.get("options", {}).items())
    versions = ", ".join(f"{key} {value}" for key, value in made_by.get("versions", {}).items())
    lines = [f"  made by    {made_by.get('stage', '?')} {options}".rstrip()]
    lines += [f"  with       vlatool {made_by.get('vlatool', '?')}{', ' + versions if versions else ''}"]
    lines += [f"  parent     {manifest.parent[:19]}"] if manifest.parent else []
    for name, measured in manifest.accuracy.items():
        interval = f" ({measured['low']:.4f} to {measured['high']:.4f})" if measured.get("low") is not None else ""
        lines.append(f"  accuracy   {name} {measured['value']:.4f}{interval}, n = {measured['samples']}")
    return lines
