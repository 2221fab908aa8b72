"""``vlatool run``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli._controllers import BUNDLE, ControllerGroup
from vlatool.cli._document import answer
from vlatool.cli._launch_words import ros_words
from vlatool.cli._options import (
    AsJson,
    BundleEngine,
    BundlePath,
    Controllers,
    Neutral,
    RobotName,
    StepDeadline,
    Threads,
)
from vlatool.errors import UsageError

if TYPE_CHECKING:
    from vlatool.measurement.dry_run import DryRun


app = typer.Typer(cls=ControllerGroup, no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Run a robot controller on a bus; or show the layers between a bundle and a robot (--dry-run)."""


@app.command(BUNDLE)
def run(
    context: typer.Context,
    bundle: BundlePath,
    robot: RobotName = "",
    deadline_ms: StepDeadline = None,
    fallback: Annotated[
        str | None,
        typer.Option(
            help="bundle that acts where this one has no action in time, or remote:ws://HOST:PORT", show_default=False
        ),
    ] = None,
    neutral: Neutral = "",
    controller: Controllers = "",
    engine: BundleEngine = "",
    threads: Threads = None,
    steps: Annotated[int, typer.Option(min=20, max=100_000, help="control steps that are measured")] = 200,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="show the layers and their times; no robot moves")] = False,
    as_json: AsJson = False,
) -> None:
    """Show the layers between a bundle and a robot, and what they leave of its control period on this machine.

    Exits with 1 when the median inference takes longer than the deadline.
    """
    if not dry_run:
        raise UsageError(
            "A bundle alone does not say which topics its inputs and actions are.",
            "run it by a controller: vlatool run policy --bundle BUNDLE --bus BUS; or add --dry-run to see the layers",
        )
    if (words := ros_words(context)) is not None:
        raise UsageError(f"'{' '.join(words.typed):.80}' is for a node of ROS, and a bundle alone is none.",
                         "leave it out, or run it by a controller: vlatool run policy --bundle BUNDLE")  # fmt: skip
    from vlatool.measurement.dry_run import dry_run as measure

    found = measure(
        bundle,
        robot=robot,
        deadline_ms=deadline_ms,
        fallback=fallback,
        neutral=neutral,
        controllers=[name for name in controller.split(",") if name],
        engine=engine,
        threads=threads,
        steps=steps,
    )
    answer(as_json, found.to_dict(), lines(found))
    found.check()


def lines(found: DryRun) -> Iterator[str]:
    """Return what a person reads: the layers from the robot inwards, then the times."""
    from vlatool.runtime.telemetry.cadence import cadence_lines

    yield f"{found.bundle}{f' on {found.robot}' if found.robot else ''}, from the robot to the graphs:"
    width = max(len(note.layer) for note in found.layers)
    for note in found.layers:
        yield f"  {note.layer:{width}}  {note.does}"
    yield from found.engine.lines()
    yield f"control period {found.period_ms:g} ms, deadline {found.deadline_ms:g} ms"
    yield f"  inference  p50 {found.inference.p50:.3f} ms, p99 {found.inference.p99:.3f} ms"
    if (slow := found.slow) is not None:
        yield f"  slow part  p50 {slow.p50:.3f} ms, p99 {slow.p99:.3f} ms, in a thread beside the inferences"
    share = f"{found.missed:.1%} of {found.answer.samples} steps without an action of the policy in time"
    yield f"  act        p50 {found.answer.p50:.3f} ms, p99 {found.answer.p99:.3f} ms; {share}"
    yield from cadence_lines(found.cadence)
    yield "a control step is answered by the first of these that has an action:"
    for number, rung in enumerate(found.rungs):
        time = "" if rung.time is None else f"  p50 {rung.time.p50:.3f} ms, p99 {rung.time.p99:.3f} ms"
        yield f"  {number}  {rung.source:10}{time}".rstrip()
