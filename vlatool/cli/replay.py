"""``vlatool replay``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli._document import answer
from vlatool.cli._options import AsJson
from vlatool.errors import GateFailed

if TYPE_CHECKING:
    from vlatool.runtime.telemetry.replay import ReplayResult


def replay(
    file: Annotated[Path, typer.Argument(help="a recorded run", show_default=False)],
    bundle: Annotated[Path, typer.Argument(help="the bundle that ran", show_default=False)],
    fallback: Annotated[
        Path | None, typer.Option(help="the second bundle that ran; its recorded answers when not given")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute a recorded run again, and say whether all outputs and actions are bit-equal, or which one is not.

    Exits with 1 at a difference.
    """
    from vlatool.runtime.replay import replay as compare

    found = compare(file, bundle, fallback=fallback)
    answer(as_json, found.to_dict(), lines(found))
    if found.difference is not None:
        raise GateFailed(
            f"Control step {found.difference.step} of {file} is not computed again as it was.",
            "compare processors, engines and their versions: bits may differ between them",
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
