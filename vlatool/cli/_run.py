"""Run one stage from the command line."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from vlatool.bundle.bundle import REPORTS as REPORTS_FOLDER
from vlatool.bundle.bundle import Bundle
from vlatool.cli import _complete
from vlatool.cli._board_summary import board_summary
from vlatool.cli._console import crew, file_or_none, progress, refuse_existing, refuse_video, show
from vlatool.cli._document import document
from vlatool.cli._options import AsJson, Force, Raw, Workers
from vlatool.errors import BundleError, GateFailed, MissingExtra, UsageError
from vlatool.files.outputs import BUNDLE
from vlatool.files.printable import one_line, printable
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.machine.instruction_sets import ENGINE, board_set
from vlatool.report import Report
from vlatool.stage.base import Context, Measure, Stage, Transform
from vlatool.stage.build import build_stage
from vlatool.stage.controls import PRUNED_KEY, controls
from vlatool.stage.finish import read_difference
from vlatool.stage.run import cache_directory, cached_transform, first_steps, measure_in_child, report_of, run_transform

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile
    from vlatool.sources import Source


def _flag(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _board_flag(about: str) -> inspect.Parameter:
    option = typer.Option("--profile", help=about, autocompletion=_complete.profiles)
    return _flag("profile", Annotated[str | None, option], None)


SOURCE = typer.Argument(
    show_default=False,
    help="a bundle, a policy directory, path.py:make or an .onnx file",
    autocompletion=_complete.sources,
)
SOURCE_FLAG = _flag("source", Annotated[str, SOURCE])
NEW_BUNDLE = typer.Option("-o", "--output", help="directory of the new bundle", show_default=False)
REPORTS = typer.Option("-o", "--output", help="directory for report.html, report.md and report.json")
EVENTS = typer.Option("--events", help="directory for events that TensorBoard reads: loss, learning rate, success")
TARGET = typer.Option("--target", help="machine to run on, through ssh: user@host, or a Host of your ssh config")
VIDEO = typer.Option(
    "--video", help="file for a video of the episode that differs most (alone: of a failed one): .gif, .mp4"
)
REMOTE_PYTHON = typer.Option("--remote-python", help="Python of the target, such as ~/venv/bin/python")
COMMON_FLAGS = (_flag("force", Force, False), _flag("as_json", AsJson, False))
TRANSFORM_FLAGS = (
    _flag("out", Annotated[Path, NEW_BUNDLE]),
    _board_flag("make it the way this board runs it, and show what to expect there (see: vlatool profiles list)"),
    *COMMON_FLAGS,
)
TRAINING_FLAGS = (_flag("events", Annotated[Path | None, EVENTS], None),)
MEASURE_FLAGS = (
    _flag("out", Annotated[Path | None, REPORTS], None),
    _board_flag(
        "add predictions for this board (see: vlatool profiles list); evaluate OpenVINO in its instruction set"
    ),
    _flag("workers", Workers, None),
    *COMMON_FLAGS,
    _flag("raw", Raw, False),
)
VIDEO_FLAGS = (_flag("video", Annotated[Path | None, VIDEO], None),)
REMOTE_FLAGS = (
    _flag("target", Annotated[str | None, TARGET], None),
    _flag("remote_python", Annotated[str | None, REMOTE_PYTHON], None),
)


def transform(
    stage: Transform,
    source: str,
    out: Path,
    force: bool,
    as_json: bool,
    profile: str | None = None,
    events: Path | None = None,
) -> None:
    """Make a bundle from a bundle, or from a policy that is exported first."""
    from vlatool.hardware.profile import load_profile
    from vlatool.sources import open_source, source_bundle

    bundle: Bundle | None
    refuse_existing(out, force, source, file_or_none(profile), *named_files(stage), kind=BUNDLE)
    if events is not None and out.absolute() in (events.absolute(), *events.absolute().parents):
        raise UsageError(
            f"--events {events} is in the output {out}, which appears whole or not at all.",
            "name a directory beside the output",
        )
    board = load_profile(profile) if profile else None
    stage = stage.on(board) if board else stage.on_this_host()
    then = following(stage, board)
    with progress() as context:
        found = open_source(source)
        if isinstance(found, Bundle):
            bundle = found
        elif stage.kind() == "export" and found.has_graphs:
            stage, bundle = _graph_source(stage, found), None
        elif stage.takes_modules:
            bundle = source_bundle(found, cache_directory(), context)
        else:
            bundle = stream_source(stage, found, context) or export_source(found, cache_directory(), context)
        context = replace(context, events=str(events.absolute()) if events else "")
        stage, bundle = first_steps(stage, bundle, cache_directory(), context)
        reports = None
        for other in then:
            bundle = cached_transform(stage, bundle, cache_directory(), context)
            if told := stage.summary(bundle):
                context.messages.extend((*told, f"loss curve: {out / REPORTS_FOLDER / 'report.html'}"))
                reports = bundle.path / REPORTS_FOLDER
            stage = other
        result = run_transform(stage, bundle, out, context, force=force, reports=reports)
        on_board = board_summary(result, bundle, board, context) if board else None
    baseline = source if isinstance(found, Bundle) else ""
    precision = {name: graph.precision for name, graph in result.manifest.graphs.items()}
    if as_json:
        document({
            "bundle": str(out), "hash": result.hash, "bytes": result.size_bytes, "precision": precision,
            "findings": result.manifest.findings, "pruned": result.manifest.made_by.get(PRUNED_KEY),
            "board": on_board.values() if on_board else None,
            "difference": asdict(difference) if (difference := read_difference(result)) else None,
        })  # fmt: skip
        _refuse(result, baseline)
        return
    graphs = f"graphs {result.graph_bytes / 1e6:.2f} MB, " if result.manifest.graphs else ""
    sizes = f"{graphs}in all {result.size_bytes / 1e6:.1f} MB"
    typer.echo(f"{out}: {one_line(result.manifest.name)} {one_line(result.manifest.version)}, {sizes}")
    for line in (*map(printable, context.messages), *stage.lines(result), *(controls(bundle) if bundle else ())):
        typer.echo(f"  {line}")
    for name, shares in precision.items():
        if not shares:
            typer.echo(f"  {name}: no matrix product or convolution is counted")
            continue
        typer.echo(f"  {name}: " + ", ".join(f"{share:.1%} {kind}" for kind, share in shares.items()) + " of the MACs")
    for line in (*_moved(result), *(on_board.lines() if on_board else ())):
        typer.echo(f"  {line}")
    _refuse(result, baseline)


def _moved(bundle: Bundle) -> Iterator[str]:
    """Yield how far the action of a new bundle is from that of the float32 bundle that it was made from."""
    if (difference := read_difference(bundle)) is None:
        return
    observations = f"{difference.samples} {'recorded' if difference.recorded else 'random'} observations"
    action = bundle.manifest.spec.action
    if action.kind == "discrete":
        yield f"{action.name}: another one than that of float32 in {difference.mean:.1%} of {observations}"
        return
    yield (
        f"{action.name}: error against float32 {difference.mean:.2%} on average, {difference.worst:.2%} at worst "
        f"({observations})"
    )


def following(stage: Transform, board: Profile | None) -> list[Transform]:
    """Return the stages that the command line runs after one, with the options that the board needs."""
    stages = [cast(Transform, build_stage(name, options)) for name, options in stage.following_stages()]
    return [each.on(board) if board else each.on_this_host() for each in stages]


def _graph_source(export: Transform, source: Source) -> Transform:
    """Return the source of a policy that is graphs, all the export that there is, with the options of that export."""
    asked = export.model_fields_set & set(type(source).model_fields)
    return source.model_copy(update={name: getattr(export, name) for name in asked})


def _refuse(bundle: Bundle, baseline: str = "") -> None:
    """Fail when a stage marked the bundle as wrong; it stays where it is, for inspection."""
    for finding in bundle.manifest.findings:
        beside = f" --baseline {shlex.quote(baseline)}" if baseline else ""
        overrule = f"load, optimize and gate refuse the bundle (to overrule: {finding['name']})"
        fix = f"vlatool explain {bundle.path}{beside}; {overrule}"
        raise GateFailed(f"{bundle.path} was written, but it is wrong: {finding['message']}", fix)


def named_files(stage: Stage) -> tuple[Path, ...]:
    """Return the files and directories that the options of a stage name."""
    values = [getattr(stage, name) for name in type(stage).model_fields]
    items = [item for value in values for item in (value if isinstance(value, tuple) else (value,))]
    return tuple(item for item in items if isinstance(item, Path))


def stream_source(stage: Transform, source: Source, context: Context) -> Bundle | None:
    """Return the bundle of a policy whose weights the stage reads from their shards itself, None for any other."""
    from vlatool.sources import source_bundle

    if not stage.streams:
        return None
    bundle = source_bundle(source, cache_directory(), context)
    try:
        stage.check(bundle, None)
    except BundleError:
        return None
    return bundle


def export_source(source: Bundle | Source, cache: Path, context: Context) -> Bundle:
    """Return a bundle as it is, and a float32 bundle with graphs of a policy, exported with the default options."""
    from vlatool.export.onnx import ExportOnnx
    from vlatool.sources import source_bundle

    bundle = source_bundle(source, cache, context)
    return (
        bundle if bundle is source or bundle.manifest.graphs else cached_transform(ExportOnnx(), bundle, cache, context)
    )


def open_with_graphs(source: str, context: Context) -> Bundle:
    """Return the bundle that is named, or that of a policy, exported with the default options."""
    from vlatool.sources import open_source

    return export_source(open_source(source), cache_directory(), context)


def measure(
    stage: Measure,
    source: str,
    out: Path | None,
    profile: str | None,
    workers: str | None,
    force: bool,
    as_json: bool,
    raw: bool = False,
    target: str | None = None,
    remote_python: str | None = None,
    video: Path | None = None,
) -> None:
    """Measure a bundle, or a policy that is exported first; here, or on a target."""
    if remote_python is not None and target is None:
        raise UsageError("--remote-python is the Python of a target.", "name it: --target user@host")
    inputs = (source, file_or_none(profile), *named_files(stage))
    refuse_existing(out, force, *inputs)
    refuse_video(video, force, out, inputs)
    board = None
    if profile:
        from vlatool.hardware.profile import load_profile

        board = load_profile(profile)
    with progress(*crew(workers)) as context:
        context = replace(context, video=str(video.absolute()) if video else "", force=force)
        bundle = open_with_graphs(source, context)
        stage.check(bundle, board)
        if target is not None:
            from vlatool.remote.ssh import measure_on

            context = replace(context, measure_remotely=partial(measure_on, target, python=remote_python or ""))
        report = _measured(stage if board is None else stage.on(board), bundle, board, context)
    if board is not None:
        report = with_predictions(report, board, bundle)
    show(report, as_json=as_json, out=out, force=force, raw=raw, unfinished=context.unfinished or ())


def _measured(stage: Measure, bundle: Bundle, board: Profile | None, context: Context) -> Report:
    """Run a stage here; evaluate a bundle of OpenVINO in the board's instruction set, where this host has that."""
    engine = getattr(stage, "engine", "") or bundle.manifest.engine
    if board is None or stage.kind() != "evaluate" or engine != ENGINE:
        return report_of(stage, bundle, context)
    computes = board_set(board)
    confine = {MAX_CPU_ISA: computes.to_set}
    report = measure_in_child(confine, stage, bundle, context) if computes.to_set else stage.run(bundle, context)
    summary, warnings = (*report.summary, *computes.about_errors()), (*report.warnings, *computes.warnings())
    return replace(report, summary=summary, warnings=warnings)


def with_predictions(report: Report, board: Profile, bundle: Bundle) -> Report:
    """Add what is predicted for a board; without onnx, the measurement stands, with a warning."""
    from vlatool.latency_model.predict import predictions
    from vlatool.optimize.choice import foretold

    row = report.rows[-1] if report.kind == "evaluate" else report.rows[0]
    try:
        predicted = replace(row, measurements=(*row.measurements, *predictions(board, bundle)))
    except MissingExtra as error:
        return replace(report, warnings=(*report.warnings, f"nothing is predicted for {board.name}: {error.message}"))
    rows = tuple(predicted if other is row else other for other in report.rows)
    first, *more = (*report.summary, "")
    return replace(report, rows=rows, summary=(first + foretold(predicted, predicted, board.name), *filter(None, more)))
