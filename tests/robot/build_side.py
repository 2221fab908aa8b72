"""The build side without torch, as Python 3.10 of a board has it: every module imports, an exported bundle works.

Usage: python tests/robot/build_side.py BUNDLE [BUNDLE ...] -o DIRECTORY

Each BUNDLE is float32, exported elsewhere; the first goes through all commands, the others through static int8 alone.
Needs onnxruntime, onnx, onnx-ir, onnxscript and safetensors beside vlatool's own requirements, and refuses to run where
torch is installed: then nothing would be shown. Exits 1 when a command leaves with another status than it should.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import pkgutil
import subprocess
import sys
from pathlib import Path

import vlatool

WANT_TORCH = ("vlatool.samples._", "vlatool.sources._lerobot_child", "vlatool.sources._openvla_network")
"""Modules that are networks, which subclass torch's own, and the script that the Python of LeRobot runs."""


def main() -> int:
    """Import everything, run the commands, and print one line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    if importlib.util.find_spec("torch") is not None:
        print("torch is installed here; this shows what works without it", file=sys.stderr)
        return 1
    print(f"Python {sys.version.split()[0]}: {imported()} modules import without torch")
    wanted = [*lines(given.bundles[0], given.output), *quantized(given.bundles, given.output / "static")]
    failed = [line for line in wanted if not ran(*line)]
    return 1 if failed else 0


def imported() -> int:
    """Import every module that is no network, and return how many."""
    names = [each.name for each in pkgutil.walk_packages(vlatool.__path__, "vlatool.")]
    wanted = [name for name in names if not name.startswith(WANT_TORCH) and not name.endswith("__main__")]
    for name in wanted:
        importlib.import_module(name)
    return len(wanted)


def lines(bundle: Path, out: Path) -> list[tuple[tuple[str, ...], int]]:
    """Return each command line, and the status with which it must leave."""
    dynamic, source = str(out / "dynamic"), str(bundle)
    settings = out / "gate.yaml"
    out.mkdir(parents=True, exist_ok=True)
    settings.write_text("schema: 1\nlatency: null\naccuracy: null\n")
    return [
        (("doctor",), 0),
        (("inspect", source), 0),
        (("quantize", "dynamic-int8", source, "-o", dynamic, "--force"), 0),
        (("quantize", "weight-only", source, "-o", str(out / "weight"), "--force"), 0),
        (("quantize", "float16", source, "-o", str(out / "half"), "--force"), 0),
        (("hwselect", source), 0),
        (("simulate", source, "--profile", "raspberry-pi-5"), 0),
        (("explain", dynamic), 0),
        (("benchmark", dynamic, "--duration", "1"), 0),
        (("gate", dynamic, "--baseline", source, "--config", str(settings)), 0),
        (("export", "sample_models/vln-babyai", "-o", str(out / "exported"), "--force"), 4),
    ]  # fmt: skip


def quantized(bundles: list[Path], out: Path) -> list[tuple[tuple[str, ...], int]]:
    """Return the command lines of static int8: an old ONNX Runtime must not end on any of these graphs."""
    layouts = (("--layout", "ort"), ("--layout", "qdq", "--reduce-range"))
    return [
        (("quantize", "static-int8", str(bundle), "-o", str(out), "--samples", "4", "--force", *layout), 0)
        for bundle in bundles
        for layout in layouts
    ]


def ran(arguments: tuple[str, ...], wanted: int) -> bool:
    """Run a command, print how it left, and say whether that is as it should."""
    done = subprocess.run([sys.executable, "-m", "vlatool", *arguments], capture_output=True, text=True)
    right = done.returncode == wanted
    print(f"{'ok' if right else 'FAILED'}: vlatool {' '.join(arguments)}: {done.returncode}")
    if not right:
        print(done.stdout[-2000:], done.stderr[-2000:])
    return right


if __name__ == "__main__":
    raise SystemExit(main())
