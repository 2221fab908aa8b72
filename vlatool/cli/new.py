"""``vlatool new``."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from vlatool.cli import _complete
from vlatool.cli._console import progress, refuse_existing
from vlatool.cli._document import document
from vlatool.cli._options import AsJson
from vlatool.cli._proposal import proposal
from vlatool.errors import UsageError
from vlatool.files.directory_writer import write_directory

Source = Annotated[
    str,
    typer.Option(
        "--from", help="file or directory that holds a policy", show_default=False, autocompletion=_complete.sources
    ),
]
Shapes = Annotated[
    list[str] | None, typer.Option("--shape", help="shape of an input that the source does not say: NAME=1,16[:DTYPE]")
]
Rate = Annotated[float | None, typer.Option(min=0.001, help="rate of the control loop in Hz; unknown if unset")]


def new(
    policy: Annotated[Path, typer.Argument(help="directory of the new policy", show_default=False)],
    source: Source,
    shape: Shapes = None,
    control_hz: Rate = None,
    as_json: AsJson = False,
) -> None:
    """Make a policy directory of a file: a copy of it, and a policy.yaml to complete. Refuses one that exists."""
    from vlatool.sources import source_stage
    from vlatool.sources._graph_source import GraphSource
    from vlatool.stage.run import cache_directory, cached_transform
    from vlatool.user_code import trust

    refuse_existing(policy, False, source, kind="")
    stage = source_stage(source)
    if stage.describe() is not None or not isinstance(stage, GraphSource):
        raise UsageError(f"{source} has a policy.yaml already.", "name it as it is: vlatool optimize SOURCE -o BUNDLE")
    stage = stage.model_copy(update={"shape": tuple(shape or ()), "control_hz": control_hz})
    stage.check(None, None)
    with progress() as context:
        bundle = cached_transform(stage, None, cache_directory(), context).bundle
    manifest = bundle.manifest
    text = proposal(manifest, stage.model.name)
    with write_directory(policy) as draft:
        for path in stage.inputs():
            (shutil.copytree if path.is_dir() else shutil.copyfile)(path, draft / path.name)
        if (assets := bundle.path / "assets").is_dir():
            shutil.copytree(assets, draft, dirs_exist_ok=True)
        (draft / "policy.yaml").write_text(text, encoding="utf-8")
    if stage.holds_code:  # the copy of what was trusted
        trust.trust(policy / stage.model.name)
    if as_json:
        document({"policy": str(policy), "source": source, "unknown": list(manifest.spec.unknown())})
        return
    typer.echo(text, nl=False)
    typer.echo(f"{policy}: complete policy.yaml, then: vlatool optimize {policy} -o BUNDLE")
