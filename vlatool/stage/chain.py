"""The stages that one stands for: those that its options ask for first, what is left of it, and those that follow."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import REPORTS, Bundle
from vlatool.errors import VlatoolError
from vlatool.stage.base import Context, Result, Transform
from vlatool.stage.build import build_stage
from vlatool.stage.run import cached_transform, run_transform

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


def steps_of(stage: Transform) -> tuple[Transform, ...]:
    """Return the stages that a recipe runs for one, itself the last; each is cached, recorded and rebuilt as if named.

    Raises:
        RecipeError: when an option cannot be read.
    """
    chain, fields = stage.chain(), type(stage).model_fields
    left = stage.model_copy(update={name: fields[name].default for name in chain.options}) if chain.before else stage
    return *_build_all(chain.before), left


def stages_after(stage: Transform, board: Profile | None) -> tuple[Transform, ...]:
    """Return the stages that the command line runs after one, with the options that the board, or this host, needs."""
    return tuple(each.on(board) for each in _build_all(stage.chain().after))


def _build_all(stages: Mapping[str, Mapping[str, Any]]) -> tuple[Transform, ...]:
    built = [build_stage(name, options) for name, options in stages.items()]
    return tuple(stage for stage in built if isinstance(stage, Transform))


def run_chain(
    stage: Transform, source: Bundle | None, board: Profile | None, out: Path, cache: Path, context: Context,
    *, force: bool = False
) -> tuple[Result, Bundle | None]:  # fmt: skip
    """Run the stages that one stands for: the last one into ``out``, and all others into the cache.

    Args:
        source: input of the first one; None for a stage that reads a policy.
        board: board that the stages after it are for; this host when None.
        force: whether to replace a directory that vlatool wrote.

    Returns:
        The new bundle with the messages of all stages, and the bundle that the last one started from.

    Raises:
        VlatoolError: what a stage raises; for one of the first, also how to run it with options of its own.
    """
    *before, left = steps_of(stage)
    if before:
        stage.check(source, None)
    steps = [*before, left, *stages_after(stage, board)]
    messages: tuple[str, ...] = ()
    reports = None
    for step in steps[:-1]:
        with _step_errors(step, stage) if step in before else contextlib.nullcontext():
            result = cached_transform(step, source, cache, context)
        source, messages = result.bundle, (*messages, *_sentences(step, result, out))
        reports = source.path / REPORTS if step.trains else reports
    result = run_transform(steps[-1], source, out, context, force=force, reports=reports)
    return replace(result, messages=(*messages, *_sentences(steps[-1], result, out))), source


def _sentences(stage: Transform, result: Result, out: Path) -> tuple[str, ...]:
    """Return what a stage did, what its bundle is like, and the page with its losses, which comes along to ``out``."""
    curve = (f"loss curve: {out / REPORTS / 'report.html'}",) if stage.trains else ()
    return (*result.messages, *stage.summarize(result.bundle), *curve)


@contextlib.contextmanager
def _step_errors(step: Transform, stage: Transform) -> Iterator[None]:
    """Say of an error in which of several stages it came, and how to give that stage other options."""
    try:
        yield
    except VlatoolError as error:
        options = ", ".join(f"{name} {_words(value)}" for name, value in step.explicit_options().items())
        command = f"vlatool {step.name().replace('.', ' ').replace('_', '-')}"
        starts = (
            f"{stage.name()} starts with {step.name()} ({options}); to give it other options, run it first: {command}"
        )
        raise type(error)(error.message, "; ".join(filter(None, (error.fix, starts)))) from error


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
