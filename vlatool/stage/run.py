"""Run a stage: input directory, stage, output directory."""

from __future__ import annotations

import contextlib
import os
import shutil
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import REPORTS, Bundle
from vlatool.errors import BundleError, DataError, VlatoolError
from vlatool.files.blob_store import mark_cache
from vlatool.files.directory_writer import write_directory
from vlatool.files.locks import acquire
from vlatool.files.outputs import BUNDLE, refuse_replacing
from vlatool.files.resumable_work import remove_all_unused
from vlatool.machine.host import cache_directory as cache_directory
from vlatool.report import REPORT, Report, read_report
from vlatool.stage import first_run
from vlatool.stage._child import child_imports, run_in_child
from vlatool.stage._child import measure_in_child as measure_in_child
from vlatool.stage.base import Context, Measure, Stage, Transform
from vlatool.user_code import children


def run_transform(
    stage: Transform,
    source: Bundle | None,
    out: Path,
    context: Context,
    *,
    force: bool = False,
    damaged: bool = False,
    reports: Path | None = None,
) -> Bundle:
    """Run a stage that makes a bundle; ``out`` appears whole or not at all.

    A stage that runs a user's code, or a graph that nobody has run yet, does so in a child process.

    Args:
        source: its input; None for a stage that starts a chain.
        force: whether to replace a directory that vlatool wrote.
        damaged: see ``vlatool.files.directory_writer.write_directory``.
        reports: directory of reports of a stage before it, which come along where this one writes none.

    Raises:
        VlatoolError: what the stage raises, and OutputError when the output cannot be written.
    """
    apart = stage.runs_graphs or bool(stage.runs(source))
    if apart and not stage.runs(source):
        imports = child_imports(stage)
        children.prepare(imports)  # while this process checks
    if not damaged:
        refuse_replacing(out, force=force, kind=BUNDLE)
    stage.check(source, None)
    with write_directory(out, force=force, damaged=damaged) as draft:
        stage.accept(run_in_child(stage, source, draft, context) if apart else stage.run(source, draft, context))
        for report in reports.iterdir() if reports is not None and reports.is_dir() else ():
            (draft / REPORTS).mkdir(exist_ok=True)
            if report.is_file() and not (draft / REPORTS / report.name).exists():
                shutil.copy2(report, draft / REPORTS)
    made = Bundle.open(out, verify=False)
    if apart:
        first_run.remember_run(made)
    return made


def cached_path(stage: Stage, source_hash: str, cache: Path) -> Path:
    """Return where the output of a stage is kept."""
    return cache / "stages" / f"{stage.name()}-{stage.key(source_hash)}"


def cached_transform(stage: Transform, source: Bundle | None, cache: Path, context: Context) -> Bundle:
    """Return the stage's bundle from the cache, or run the stage into the cache."""
    path = cached_path(stage, source.hash if source else "", cache)
    if acquire(path):
        try:
            return Bundle.open(path)
        except BundleError:
            context.progress(f"the cached {stage.name()} is damaged; making it again", None)
    mark_cache(cache)
    bundle = run_transform(stage, source, path, context, damaged=True)
    acquire(path)
    return bundle


def first_steps(
    stage: Transform, source: Bundle | None, cache: Path, context: Context
) -> tuple[Transform, Bundle | None]:
    """Run the stages that a stage asks for first, into the cache.

    Returns:
        What is left of the stage, and the bundle that it starts from.

    Raises:
        VlatoolError: what a stage raises, and how to run that stage with options of its own.
    """
    *first, last = stage.chain()
    if first:
        stage.check(source, None)
    for step in first:
        try:
            source = cached_transform(step, source, cache, context)
        except VlatoolError as error:
            raise type(error)(error.message, "; ".join(filter(None, (error.fix, _failed_step(step, stage))))) from error
    return last, source


def _failed_step(step: Transform, stage: Transform) -> str:
    """Return in words which stage of several failed, and how to give it other options."""
    options = ", ".join(f"{name} {_words(value)}" for name, value in step.explicit_options().items())
    command = f"vlatool {step.name().replace('.', ' ').replace('_', '-')}"
    return f"{stage.name()} starts with {step.name()} ({options}); to give it other options, run it first: {command}"


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def report_of(stage: Measure, source: Bundle, context: Context) -> Report:
    """Run a stage that measures; in a child process where it opens graphs itself."""
    return measure_in_child({}, stage, source, context) if stage.runs_graphs else stage.run(source, context)


def cached_measure(stage: Measure, source: Bundle, cache: Path, context: Context, *, fresh: bool = False) -> Report:
    """Return the stage's report from the cache, or measure (always, when ``fresh``) and keep it."""
    path = cached_path(stage, source.hash, cache)
    if path.is_dir() and not fresh:
        try:
            report = read_report(path)
            with contextlib.suppress(OSError):  # a cache that may only be read
                os.utime(path)
            return report
        except DataError:
            context.progress(f"the cached {stage.name()} is damaged; measuring again", None)
    own = replace(context, unfinished=[], notes=[])
    report = replace(report_of(stage, source, own), created=datetime.now(timezone.utc).isoformat(timespec="seconds"))
    mark_cache(cache)
    with write_directory(path, damaged=True) as draft:
        (draft / REPORT).write_text(report.to_json(), encoding="utf-8")
    context.notes.extend(own.notes)
    remove_all_unused(own.unfinished or ())
    return report
