"""``vlatool samples``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool import registry
from vlatool.cli import _complete
from vlatool.cli._console import progress, refuse_existing
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, Force
from vlatool.errors import MissingExtra, UsageError, VlatoolError, fix_for, suggest
from vlatool.files.directory_writer import write_directory

app = typer.Typer(help="Random-weight policies of realistic shape.", no_args_is_help=True, rich_markup_mode=None)


@app.command("list")
def list_samples(as_json: AsJson = False) -> None:
    """List the shapes that can be made."""
    descriptions = {name: registry.module("samples", name).DESCRIPTION for name in _complete.samples("")}
    rows = [{"name": name, "description": text} for name, text in descriptions.items()]
    answer(as_json, rows, [f"{name:16} {text}" for name, text in descriptions.items()])


@app.command("make")
def make(
    name: Annotated[
        str,
        typer.Argument(
            help="name of the sample (see: vlatool samples list)", show_default=False, autocompletion=_complete.samples
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="directory of the new policy", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="seed of weights and data")] = 0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a policy with seeded random weights, to study latency and memory."""
    from vlatool.boards.answer import carry_count
    from vlatool.samples import write_sample

    known = _complete.samples("")
    if name.replace("_", "-") not in known:
        raise UsageError(f"Unknown sample '{name}'; {suggest(name, known)}.", fix_for(name, known))
    refuse_existing(output, force, kind="")
    with write_directory(output, force=force) as draft:
        write_sample(name.replace("-", "_"), draft, seed)
    try:
        with progress() as context:
            carry_count(str(output), context)
    except MissingExtra:
        pass  # counted where torch is installed
    except (VlatoolError, OSError) as error:
        typer.echo(f"warning: it has no count: {error}", err=True)
    value = {"policy": str(output), "sample": name.replace("_", "-"), "seed": seed}
    answer(as_json, value, [f"{output}: {name}, seed {seed}"])
