"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool.cli import _complete

BundleOrSource = Annotated[
    str, typer.Argument(help="a bundle or a policy source", show_default=False, autocompletion=_complete.sources)
]
Force = Annotated[bool, typer.Option("--force", help="replace an output that exists")]
Json = Annotated[bool, typer.Option("--json", help="print JSON on stdout")]
ReportOutput = Annotated[Path | None, typer.Option("-o", "--output", help="directory for the report")]
