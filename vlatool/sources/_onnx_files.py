"""ONNX files on disk: read, and pointed out in a directory that names no factory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlatool.errors import SourceError, require
from vlatool.module.description import FILE

WHERE_MADE = "fix the file where it was made; onnx.checker.check_model(FILE, full_check=True) may say more"


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


def load_onnx(path: Path) -> Any:
    onnx = require("onnx", "build")
    try:
        model = onnx.load(str(path))
    except Exception as error:  # the seam: protobuf and onnx raise many foreign types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise SourceError(f"{path} is not a readable ONNX file: {reason}.", WHERE_MADE) from error
    if not model.graph.node:
        raise SourceError(f"{path} is not an ONNX model: its graph has no nodes.", WHERE_MADE)
    return model
