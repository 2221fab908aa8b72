"""Run one stage from the command line."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import unknown_warning
from vlatool.cli import _complete
from vlatool.cli._board_summary import BoardSummary, board_summary
from vlatool.cli._console import crew, file_or_none, progress, refuse_existing, refuse_video, show
from vlatool.cli._document import document
from vlatool.cli._options import AsJson, Force, Raw, Workers
from vlatool.cli._proposal import propose
from vlatool.errors import BundleError, GateFailed, MissingExtra, UsageError
from vlatool.files.outputs import BUNDLE
from vlatool.files.printable import one_line, printable
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.machine.instruction_sets import ENGINE, board_set
from vlatool.module.stage import describe_modules
from vlatool.report import Report
from vlatool.stage.base import Context, Measure, Result, Stage, Transform
from vlatool.stage.chain import run_chain
from vlatool.stage.controls import PRUNED_KEY, controls
from vlatool.stage.finish import read_difference
from vlatool.stage.run import cache_directory, cached_transform, measure_in_child, report_of, work_folder

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
    help="a bundle, a policy directory, path.py:make, or a file that holds a policy: .onnx, .pt, .pt2, LEAPP",
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
MEASURE_FLAGS = (
    _flag("out", Annotated[Path | None, REPORTS], None),
    _board_flag(
        "add predictions for this board (see: vlatool profiles list); evaluate OpenVINO in its instruction set"
    ),
    _flag("workers", Workers, None),
    *COMMON_FLAGS,
    _flag("raw", Raw, False),
)
FLAGS_OF = {
    "remotely": (
        _flag("target", Annotated[str | None, TARGET], None),
        _flag("remote_python", Annotated[str | None, REMOTE_PYTHON], None),
    ),
    "films": (_flag("video", Annotated[Path | None, VIDEO], None),),
    "trains": (_flag("events", Annotated[Path | None, EVENTS], None),),
}
"""What a class says of itself -> flags that its command has, too."""


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
    from vlatool.sources import open_source

    refuse_existing(out, force, source, file_or_none(profile), *named_files(stage), kind=BUNDLE)
    _refuse_events(events, out)
    board = _board(profile)
    stage = stage.on(board)
    with progress() as context:
        context = replace(context, events=str(events.absolute()) if events else "")
        opened = open_source(source)
        stage, start, messages = _start(stage, opened, context)
        result, before = run_chain(stage, start, board, out, cache_directory(), context, force=force)
        on_board = board_summary(result.bundle, before, board, context) if board else None
    propose(source, result.bundle.manifest, out)
    if as_json:
        document(_as_json(result.bundle, out, on_board))
    else:
        typer.echo("\n  ".join(_lines(result.bundle, out, before, (*messages, *result.messages), on_board)))
    _refuse(result.bundle, source if isinstance(opened, Bundle) else "")
    _refuse_newer(result.bundle, board)


def _refuse_newer(bundle: Bundle, board: Profile | None) -> None:
    """Fail when a graph has an opset that the board's engine does not take; the bundle stays where it is."""
    limit = board.engines[board.engine].opset if board else None
    newer = {name: graph.opset for name, graph in bundle.manifest.graphs.items() if limit and graph.opset > limit.value}
    if board and limit and newer:
        graphs = ", ".join(f"{name} has opset {opset}" for name, opset in newer.items())
        raise GateFailed(
            f"{bundle.path} was written, but {board.engine} on {board.name} takes opset {limit.value:g} at most: "
            f"{graphs}.",
            f"vlatool export opset {bundle.path} --profile {board.name} -o NEW",
        )


def _board(profile: str | None) -> Profile | None:
    if not profile:
        return None
    from vlatool.hardware.profile import load_profile

    return load_profile(profile)


def _refuse_events(events: Path | None, out: Path) -> None:
    if events is not None and out.absolute() in (events.absolute(), *events.absolute().parents):
        raise UsageError(
            f"--events {events} is in the output {out}, which appears whole or not at all.",
            "name a directory beside the output",
        )


def _start(
    stage: Transform, opened: Bundle | Source, context: Context
) -> tuple[Transform, Bundle | None, tuple[str, ...]]:
    """Return a stage, what it starts from, and sentences on that: a bundle, or what is made of a policy."""
    from vlatool.sources import source_bundle

    if isinstance(opened, Bundle):
        return stage, opened, ()
    if stage.kind() == "export" and stage.takes_modules and opened.has_graphs:
        return _graph_source(stage, opened), None, ()
    start = source_bundle(opened, cache_directory(), context)
    if not _takes_source(stage, start.bundle):
        start = with_graphs(start, cache_directory(), context)
    return stage, start.bundle, start.messages


def _takes_source(stage: Transform, bundle: Bundle) -> bool:
    """Return whether a stage takes the source bundle of a policy: its modules, or the shards of its weights."""
    if stage.takes_modules or not stage.streams:
        return stage.takes_modules
    try:
        stage.check(bundle, None)
    except BundleError:
        return False
    return True


def _lines(
    bundle: Bundle, out: Path, before: Bundle | None, messages: Iterable[str], on_board: BoardSummary | None
) -> Iterator[str]:
    """Yield what is printed of a new bundle, and of the one before it."""
    graphs = f"graphs {bundle.graph_bytes / 1e6:.2f} MB, " if bundle.manifest.graphs else ""
    sizes = f"{graphs}in all {bundle.size_bytes / 1e6:.1f} MB"
    yield f"{out}: {one_line(bundle.manifest.name)} {one_line(bundle.manifest.version)}, {sizes}"
    yield from map(printable, messages)
    yield from () if bundle.manifest.graphs else describe_modules(bundle)
    yield from controls(before) if before else ()
    yield from (*_precisions(bundle), *_difference(bundle), *(on_board.lines() if on_board else ()))


def _precisions(bundle: Bundle) -> Iterator[str]:
    """Yield which shares of its multiply-accumulates each graph computes in which type."""
    for name, graph in bundle.manifest.graphs.items():
        shares = ", ".join(f"{share:.1%} {kind}" for kind, share in graph.precision.items())
        yield f"{name}: {shares} of the MACs" if shares else f"{name}: no matrix product or convolution is counted"


def _as_json(bundle: Bundle, out: Path, on_board: BoardSummary | None) -> dict[str, Any]:
    difference = read_difference(bundle)
    return {
        "bundle": str(out), "hash": bundle.hash, "bytes": bundle.size_bytes,
        "precision": {name: graph.precision for name, graph in bundle.manifest.graphs.items()},
        "findings": bundle.manifest.findings, "pruned": bundle.manifest.made_by.get(PRUNED_KEY),
        "board": on_board.values() if on_board else None,
        "difference": asdict(difference) if difference else None,
    }  # fmt: skip


def _difference(bundle: Bundle) -> Iterator[str]:
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


def _graph_source(export: Transform, source: Source) -> Transform:
    """Return the source of a policy that is graphs, all the export that there is, with the options of that export."""
    asked = export.model_fields_set & set(type(source).model_fields)
    if "exporter" in export.model_fields_set - asked:
        raise UsageError("--exporter: this policy is a file that torch does not export.", "leave --exporter out")
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


def with_graphs(source: Result, cache: Path, context: Context) -> Result:
    """Return a source bundle that has graphs, and any other one exported to float32 with the default options."""
    from vlatool.export.onnx import ExportOnnx

    if source.bundle.manifest.graphs:
        return source
    exported = cached_transform(ExportOnnx(), source.bundle, cache, context)
    return replace(exported, messages=(*source.messages, *exported.messages))


def open_with_graphs(source: str, context: Context) -> Bundle:
    """Return the bundle that is named, or that of a policy, exported with the default options."""
    from vlatool.sources import open_source, source_bundle

    if isinstance(opened := open_source(source), Bundle):
        return opened
    return with_graphs(source_bundle(opened, cache_directory(), context), cache_directory(), context).bundle


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
    board = _board(profile)
    with progress(*crew(workers)) as context:
        context = replace(context, video=str(video.absolute()) if video else "", force=force)
        bundle = open_with_graphs(source, context)
        stage.check(bundle, board)
        if target is not None:
            from vlatool.remote.ssh import measure_on

            context = replace(context, measure_remotely=partial(measure_on, target, python=remote_python or ""))
        stage = stage.on(board)
        work = work_folder(stage, bundle)
        context = replace(context, work=str(work.absolute()))
        report = _measured(stage, bundle, board, context)
    if board is not None:
        report = with_predictions(report, board, bundle)
    propose(source, bundle.manifest, out)
    report = replace(report, warnings=(*report.warnings, *unknown_warning(bundle.manifest.spec)))
    show(report, as_json=as_json, out=out, force=force, raw=raw, unfinished=[work])


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
