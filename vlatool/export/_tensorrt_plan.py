"""The plan of TensorRT engines: files with hashes, shapes, workspace, and two programs that build by it."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, SpecError
from vlatool.export._interface import graph_entry, write_interface
from vlatool.export._tensorrt_operators import support_list

FOLDER = "tensorrt"
PYTHON = Path(__file__).parent / "data/build_engines.txt"
"""The program that builds on the board; it needs tensorrt alone."""
KEYS = ("min", "opt", "max")
HEAD = """\
#!/bin/sh
# Builds the engines of this bundle on the board that runs them, with trtexec of TensorRT 10.
set -e
cd "$(dirname "$0")"
mkdir -p engines
"""
Ranges = Mapping[str, tuple[tuple[int, ...], ...]]
"""Input -> least, usual and largest shape."""


def ranges_from(texts: tuple[str, ...]) -> Ranges:
    """Return input -> least, usual and largest shape of what a person typed.

    Raises:
        RecipeError: for anything else.

    Example:
        >>> ranges_from(("ids=1x8:1x16:1x48",))
        {'ids': ((1, 8), (1, 16), (1, 48))}
    """
    ranges = {}
    for text in texts:
        name, _, listed = text.rpartition("=")
        parts = listed.split(":")
        right = bool(name) and len(parts) == 3 and all(re.fullmatch(r"[1-9]\d*(x[1-9]\d*)*", part) for part in parts)
        shapes = tuple(tuple(map(int, part.split("x"))) for part in parts) if right else ()
        alike = len({len(shape) for shape in shapes}) == 1
        if not alike or not all(a <= b <= c for a, b, c in zip(*shapes, strict=True)):
            raise RecipeError(
                f"--shapes {text!r} is not a range of shapes; wanted NAME=MIN:OPT:MAX, each as 1x3x224x224, rising.",
                "write it like --shapes ids=1x8:1x16:1x48",
            )
        ranges[name] = shapes
    return ranges


def write_plan(source: Bundle, out: Path, files: Mapping[str, Path], workspace_mb: int, ranges: Ranges) -> None:
    """Write ``tensorrt/``: plan.json, build.sh, build.py and interface.json.

    Args:
        files: graph name -> ONNX file in ``out``.

    Raises:
        SpecError: when an input has a free axis without a range, or a range fits no input.
    """
    (out / FOLDER).mkdir()
    entries: dict[str, dict[str, Any]] = {}
    plan: dict[str, dict[str, Any]] = {}
    for name, file in files.items():
        data = file.with_name(f"{file.name}.data")
        roles = {"model": file, **({"weights": data} if data.exists() else {})}
        entries[name] = graph_entry(source, name, file, roles, out)
        shapes = {port["name"]: _range_of(port["name"], port["shape"], ranges) for port in entries[name]["inputs"]}
        stored = {f"../{each['file']}": each["sha256"] for each in entries[name]["files"].values()}
        plan[name] = {
            "file": f"../{file.relative_to(out).as_posix()}", "sha256": stored, "shapes": shapes,
            "engine": f"engines/{name}.engine",
        }  # fmt: skip
    known = {input_name for graph in plan.values() for input_name in graph["shapes"]}
    if unknown := set(ranges) - known:
        raise SpecError.unknown("--shapes names an input that no graph has", min(unknown), known)
    listed = {key: support_list()[key] for key in ("tensorrt", "opset", "source")}
    content = {"parser": listed, "strongly_typed": True, "workspace_mb": workspace_mb, "graphs": plan}
    (out / FOLDER / "plan.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (out / FOLDER / "build.sh").write_text(_shell(plan, workspace_mb), encoding="utf-8")
    shutil.copyfile(PYTHON, out / FOLDER / "build.py")
    write_interface(out / FOLDER / "interface.json", source, entries)


def _range_of(name: str, axes: list[int | str], ranges: Ranges) -> dict[str, list[int]]:
    """Return the least, usual and largest shape of an input.

    Raises:
        SpecError: when it has a free axis that nobody gave a range, or a range does not fit.
    """
    free = [axis for axis in axes if not isinstance(axis, int) or axis < 1]
    if name not in ranges and free:
        shape = "x".join(map(str, axes))
        raise SpecError(
            f"The input '{name}' has the free axes {', '.join(map(str, free))}; TensorRT needs a range of each.",
            f"add --shapes {name}={shape}:{shape}:{shape} with numbers in the place of names",
        )
    given = ranges.get(name, (tuple(int(axis) for axis in axes if axis not in free),) * 3)
    for wanted in given:
        fits = len(wanted) == len(axes) and all(a in free or a == b for a, b in zip(axes, wanted, strict=True))
        if not fits:
            message = f"--shapes gives '{name}' the shape {list(wanted)}; the graph has {axes}."
            raise SpecError(message, "correct --shapes; only free axes have a range")
    return {key: list(shape) for key, shape in zip(KEYS, given, strict=True)}


def _shell(plan: Mapping[str, Mapping[str, Any]], workspace_mb: int) -> str:
    """Return the script that builds every engine with trtexec."""
    lines = []
    for graph in plan.values():
        lines += [
            f"echo {shlex.quote(f'{digest}  {file}')} | sha256sum -c -" for file, digest in graph["sha256"].items()
        ]
        words = [f"--onnx={graph['file']}", f"--saveEngine={graph['engine']}", "--stronglyTyped", "--skipInference"]
        words.append(f"--memPoolSize=workspace:{workspace_mb}M")
        if any(each["min"] != each["max"] for each in graph["shapes"].values()):
            words += [f"--{key}Shapes={_sizes(graph['shapes'], key)}" for key in KEYS]
        lines.append(" ".join(map(shlex.quote, ["trtexec", *words])))
    return HEAD + "\n".join(lines) + "\n"


def _sizes(shapes: Mapping[str, Mapping[str, list[int]]], key: str) -> str:
    return ",".join(f"{name}:{'x'.join(map(str, each[key]))}" for name, each in shapes.items())
