"""``vlatool record``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli import _complete
from vlatool.cli._document import answer
from vlatool.cli._launch_words import ros_words
from vlatool.cli._options import (
    AsJson,
    BundleEngine,
    BusName,
    Controllers,
    Neutral,
    RobotName,
    StepDeadline,
    Threads,
)
from vlatool.cli._signals import stopped_by_signals
from vlatool.errors import UsageError
from vlatool.files.printable import printable

if TYPE_CHECKING:
    from vlatool.buses import RosWords

NODE = f"vlatool_record_{os.getpid()}"
"""In ROS 1 a second node of the same name ends the first one."""


def record(
    context: typer.Context,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="new file; NAME.mcap, NAME.db3 or NAME.bag of a bus", show_default=False),
    ],
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="BUNDLE|TOPIC...",
            help="a bundle; with --bus topics, all when none is named",
            show_default=False,
            autocompletion=_complete.bundles,
        ),
    ] = None,
    bus: BusName = "",
    seconds: Annotated[
        float | None, typer.Option(min=0, help="with --bus: end after so many seconds; at Ctrl-C when not given")
    ] = None,
    robot: RobotName = "",
    deadline_ms: StepDeadline = None,
    fallback: Annotated[
        Path | None, typer.Option(help="bundle that acts where this one has no action in time", show_default=False)
    ] = None,
    neutral: Neutral = "",
    controller: Controllers = "",
    engine: BundleEngine = "",
    threads: Threads = None,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="control steps")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="seed of the noise")] = 0,
    as_json: AsJson = False,
) -> None:
    """Record control steps of a bundle on this machine, or the topics of a bus, to compute them again with replay.

    Of a bundle, no robot moves; on a robot, load(..., record=FILE) records the same. Of a bus, start it before the
    controller, so that the first step is in the bag.
    """
    words = what or []
    if bus:
        _record_bus(bus, output, words, seconds, as_json, ros_words(context))
        return
    if ros_words(context) is not None:
        raise UsageError(
            "A bundle is not a node, and there are words of a launcher of ROS.", "pass --bus ros1 to record a bus"
        )
    if len(words) != 1:
        raise UsageError(f"{len(words)} bundles are named to record; allowed: one, or topics with --bus.",
                         "name a bundle, or pass --bus BUS")  # fmt: skip
    from vlatool.measurement.recorded_run import record_run

    found = record_run(
        Path(words[0]),
        output,
        robot=robot,
        deadline_ms=deadline_ms,
        fallback=fallback,
        neutral=neutral,
        controllers=[name for name in controller.split(",") if name],
        engine=engine,
        threads=threads,
        steps=steps,
        seed=seed,
    )
    answer(as_json, found.to_dict(), [f"{found.file}: {found.steps} control steps, {found.bytes / 1e6:.3g} MB"])


def _record_bus(
    bus: str, output: Path, topics: list[str], seconds: float | None, as_json: bool, words: RosWords | None
) -> None:
    """Record topics of a bus to a new bag, under the names that they have there: remappings are left out."""
    from vlatool.buses import open_bus
    from vlatool.buses.bag import Bag
    from vlatool.nodes.bus_recorder import BusRecorder, RecordSummary
    from vlatool.nodes.fault_watch import fault_text, to_plain_faults

    if not str(output).strip(" ."):
        raise UsageError(f"'{output}' is not the name of a bag.", "write for example -o run.mcap")
    if ":" in str(output):
        raise UsageError(f"The bag '{output}' has a colon in its name, which separates bags.", "name it without one")
    opened = open_bus(bus, NODE, None if words is None else words.without_topics())
    summary = RecordSummary()
    try:
        bag = Bag(f":{output}", NODE)
        try:
            recorder = BusRecorder(opened, bag, NODE, topics)
            summary = recorder.summary
            with stopped_by_signals(recorder.stop):
                recorder.run(seconds)
        finally:
            bag.close()
        faults = opened.faults()
    finally:
        opened.close()
    path = bag.new_path or output
    lines = [f"{path}: {sum(summary.messages.values())} messages of {len(summary.messages)} topics in "
             f"{summary.seconds:.1f} s"]  # fmt: skip
    lines += [f"  {topic}  {count}" for topic, count in sorted(summary.messages.items())]
    lines += [f"  {topic} is not recorded: {why}" for topic, why in sorted(summary.unknown.items())]
    lines += [f"  on the bus: {fault_text(fault)}" for fault in faults]
    answer(as_json, {"file": str(path), **vars(summary), "faults": to_plain_faults(faults)}, map(printable, lines))
