"""The files of a checkpoint as values, written into a directory, and changes of one entry."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save_file


def write(folder: Path, files: Mapping[str, Any]) -> Path:
    """Write files: bytes and text as they are, JSON, and tensors."""
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        if isinstance(content, bytes):
            (folder / name).write_bytes(content)
        elif name.endswith(".json"):
            (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))
        else:
            save_file({key: _tensor(value) for key, value in content.items()}, folder / name)
    return folder


def _tensor(value: Any) -> Any:
    return value if isinstance(value, np.ndarray) else np.asarray(value, np.float32)


def edited(*path: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    """Return what replaces an entry of the files, or removes it when ``to`` is None."""

    def edit(files: dict[str, Any]) -> None:
        *way, last = path
        inside: Any = files
        for key in way:
            inside = inside[key]
        if to is None:
            del inside[last]
        else:
            inside[last] = to

    return edit
