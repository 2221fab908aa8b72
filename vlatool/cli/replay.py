"""``vlatool replay``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool import registry
from vlatool.cli import _complete
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson
from vlatool.errors import DataError, GateFailed, UsageError
from vlatool.files.printable import amount, printable
from vlatool.machine.version import VERSION

if TYPE_CHECKING:
    from vlatool.runtime.telemetry.replay import ReplayResult


def replay(
    file: Annotated[Path, typer.Argument(help="a recorded run, or a bag", show_default=False)],
    what: Annotated[
        str,
        typer.Argument(
            metavar="BUNDLE|CONTROLLER", help="the bundle or the robot controller that ran", show_default=False
        ),
    ],
    bundle: Annotated[
        Path | None, typer.Option(help="bundle of the controller's policy", autocompletion=_complete.bundles)
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="JSON file of other settings than the recorded ones (controllers)")
    ] = None,
    fallback: Annotated[
        Path | None, typer.Option(help="the second bundle that ran; its recorded answers when not given")
    ] = None,
    node: Annotated[str, typer.Option(help="node of the controller, where a bag has several of its kind")] = "",
    as_json: AsJson = False,
) -> None:
    """Compute a recorded run again, and say whether all outputs, actions or commands are bit-equal, or which is not.

    A run of a bundle is that of vlatool record or load(..., record=FILE). A run of a robot controller is the log of
    vlatool run --record, or a bag with the messages that it read and the topics /NODE/steps and /NODE/controller.

    Exits with 1 at a difference.
    """
    if is_controller(what):
        _replay_controller(file, what, node, bundle, settings, as_json)
        return
    if bundle is not None or settings is not None:
        raise UsageError(f"--bundle and --settings are for a robot controller, and {what} is a bundle.",
                         "leave them out")  # fmt: skip
    from vlatool.runtime.replay import replay as compare

    found = compare(file, what, fallback=fallback)
    answer(as_json, found.to_dict(), lines(found))
    if found.difference is not None:
        raise GateFailed(
            f"Control step {found.difference.step} of {file} is not computed again as it was.",
            "compare processors, engines and their versions: bits may differ between them",
        )


def is_controller(what: str) -> bool:
    """Return whether a word is the name of a robot controller, and of no bundle here."""
    return what.replace("-", "_") in registry.names("controllers") and not Path(what).exists()


def _replay_controller(
    file: Path, name: str, node: str, bundle: Path | None, settings: Path | None, as_json: bool
) -> None:
    """Compute the run of a robot controller again; its node is named where a bag has several."""
    from vlatool.nodes.launch import PolicyOptions, open_controller
    from vlatool.nodes.recordings import open_recording
    from vlatool.nodes.replay import lines as replay_lines
    from vlatool.nodes.replay import replay as compare
    from vlatool.nodes.settings import read_settings, settings_of

    recording = open_recording(file, name, node)
    known = {setting.name for setting in settings_of(registry.load("controllers", name))}
    if newer := sorted({*recording.about.settings} - known):
        raise DataError(
            f"{file} was recorded with the setting '{newer[0]}', which {name} does not have in vlatool {VERSION}.",
            f"replay it with vlatool {recording.about.version or 'as it was then'}",
        )
    chosen = {**recording.about.settings, **({} if settings is None else read_settings(settings))}
    options = PolicyOptions(bundle, recording.about.robot, deadline_ms=0)
    found = compare(open_controller(name, chosen, options), recording.items(), recording.topics)
    answer(as_json, found.to_dict(), map(printable, replay_lines(found)))
    if found.altered and found.difference is None:
        raise GateFailed(f"{file} has {amount(found.altered, 'command')} that no step sent.",
                         "look for a second publisher; the recorded topic is not what was computed")  # fmt: skip
    if not found.equal:
        raise GateFailed(
            f"{found.differing} of {found.steps} steps of {file} are not computed again as they were.",
            "compare the settings, the bundle and the processor; a deadline that was missed differs, too",
        )


def lines(found: ReplayResult) -> Iterator[str]:
    """Return what a person reads."""
    different = found.difference
    if different is None:
        yield f"{found.steps} control steps: bit-equal" if found.steps else "no control step was compared"
    else:
        position = f"{list(different.element)}" if different.element else ""
        yield (f"step {different.step}, {different.output}{position}: recorded {different.recorded}, "
               f"replayed {different.replayed}")  # fmt: skip
    if found.note:
        yield f"the recording ends there: {found.note}"
