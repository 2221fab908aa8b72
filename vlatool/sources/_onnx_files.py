"""A directory that holds ONNX files and names no factory: a file itself is the source."""

from __future__ import annotations

from pathlib import Path

from vlatool.errors import SourceError
from vlatool.module.description import FILE


def refuse_bare(folder: Path) -> None:
    """Refuse a directory that holds ONNX files, where nothing else in it is a policy.

    Raises:
        SourceError: naming the file, or all of them.
    """
    files = sorted(folder.glob("*.onnx"))[:4]
    if not files:
        return
    described = (folder / FILE).is_file()
    names = ", ".join(map(str, files))
    lacks = f"a {FILE} without a 'source'" if described else f"no {FILE}"
    beside = "" if described else f"; a {FILE} beside it may describe inputs and outputs"
    raise SourceError(
        f"{folder} holds ONNX files ({', '.join(file.name for file in files)}) and {lacks}.",
        f"name the file: {names if len(files) == 1 else f'one of {names}'}{beside}",
    )
