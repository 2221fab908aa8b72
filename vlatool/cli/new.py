"""``vlatool new``."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.bundle.spec import UNKNOWN
from vlatool.cli import _complete
from vlatool.cli._console import progress, refuse_existing
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson
from vlatool.cli._proposal import proposal
from vlatool.errors import OutputError, UsageError
from vlatool.files.directory_writer import write_directory
from vlatool.files.printable import one_line

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

    if os.path.lexists(policy):
        raise OutputError(f"{policy} exists already.", "name a directory that does not exist; nothing is replaced")
    refuse_existing(policy, False, source, kind="")
    stage: Any = source_stage(source)
    if (converted := stage.converted_directory()) is not None:
        if shape:
            raise UsageError(f"--shape is given, and {source} says the shapes of all inputs.", "leave --shape out")
        text, unknown = _copy(converted, policy, control_hz)
    else:
        text, unknown = _make(stage, source, shape, control_hz, policy)
    value = {"policy": str(policy), "source": source, "unknown": list(unknown)}
    then = f"{policy}: complete policy.yaml, then: vlatool optimize {policy} -o BUNDLE"
    answer(as_json, value, [text.removesuffix("\n"), then])


def _make(
    stage: Any, source: str, shape: list[str] | None, control_hz: float | None, policy: Path
) -> tuple[str, Iterable[str]]:
    """Write a directory with the files of a policy and what is proposed; return that, and what is unknown."""
    from vlatool.stage.run import cache_directory, cached_transform
    from vlatool.user_code import trust

    if stage.describe() is not None:
        raise UsageError(f"{source} has a policy.yaml already.", "name it as it is: vlatool optimize SOURCE -o BUNDLE")
    stage = stage.model_copy(update={"shape": tuple(shape or ()), "control_hz": control_hz})
    stage.check(None, None)
    with progress() as context:
        bundle = cached_transform(stage, None, cache_directory(), context).bundle
    manifest = replace(bundle.manifest, name=_name(policy, bundle.manifest.name))
    text = proposal(manifest, stage.model.name)
    with write_directory(policy) as draft:
        for path in stage.inputs():
            copy = draft / path.relative_to(stage.model.parent)
            copy.parent.mkdir(parents=True, exist_ok=True)
            (shutil.copytree if path.is_dir() else shutil.copyfile)(path, copy)
        if (assets := bundle.path / "assets").is_dir():
            shutil.copytree(assets, draft, dirs_exist_ok=True)
        (draft / "policy.yaml").write_text(text, encoding="utf-8")
    if stage.holds_code:  # the copy of what was trusted
        trust.trust(policy / stage.model.name)
    return text, manifest.spec.unknown()


def _copy(converted: Path, policy: Path, control_hz: float | None) -> tuple[str, Iterable[str]]:
    """Write the directory that a checkpoint was converted into, with the rate that was given; return as ``_make``."""
    from vlatool.module.description import FILE, read_description

    with write_directory(policy) as draft:
        left_out = shutil.ignore_patterns(".*", "__pycache__")
        shutil.copytree(converted, draft, symlinks=True, dirs_exist_ok=True, ignore=left_out)  # weights stay in place
        text = (draft / FILE).read_text(encoding="utf-8")
        name = _name(policy, read_description(draft).name)
        text = re.sub(r"^name: .*$", lambda _: f"name: {json.dumps(name)}", text, count=1, flags=re.MULTILINE)
        if control_hz is not None:
            text = text.replace(f"control_hz: {UNKNOWN}", f"control_hz: {control_hz:g}")
        (draft / FILE).write_text(text, encoding="utf-8")
    return text, read_description(policy).spec.unknown()


def _name(policy: Path, own: str) -> str:
    """Return the name of the new directory as that of its policy; the source's ``own`` where it cannot be one."""
    from vlatool.module.description import MAX_LABEL_CHARACTERS

    name = policy.resolve().name
    return name if one_line(name, MAX_LABEL_CHARACTERS) == name else own
