"""``vlatool simulate``."""

from __future__ import annotations

from typing import Annotated

import typer

from vlatool.cli import _complete
from vlatool.cli._console import progress
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BundleOrSource


def simulate(
    source: BundleOrSource,
    profile: Annotated[str, typer.Option(help="the board", show_default=False, autocompletion=_complete.profiles)],
    mode: Annotated[str | None, typer.Option(help="power mode; the default one when not given")] = None,
    engine: Annotated[
        str | None,
        typer.Option(help="engine; the board's preferred one when not given", autocompletion=_complete.engines),
    ] = None,
    precision: Annotated[
        str, typer.Option(help="precision; as the policy is stored when not given", autocompletion=_complete.precisions)
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Predict where a policy's time would go on a board, and what int8, fewer steps or pruning would save."""
    from vlatool.boards.answer import simulate, simulation_lines

    with progress() as context:
        prediction = simulate(source, profile, mode, engine, precision, context)
    answer(as_json, prediction, simulation_lines(prediction))
