"""How much memory each process of a training holds, with and without ``--shard``.

``python tests/validation/soak/shard_memory.py --layers 10 --width 2048`` writes a policy of that many blocks (127 M
weights), prunes its neurons, and distils the result for a few steps in two processes, first with whole weights in each
and then with parts. Prints the peak of the resident set (VmHWM) of the two largest processes, the training ones, and
how far the weights are apart.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from _deep import write_deep
from safetensors import safe_open

from vlatool.machine.processes import import_path

BATCHED = ("reshape(1, 4, 2)", "reshape(-1, 4, 2)")


def run(*words: str) -> dict[int, int]:
    """Run a command of vlatool; return the peak of the resident set of it and of all that it starts, in bytes."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(import_path())}
    process = subprocess.Popen([sys.executable, "-m", "vlatool", *words], env=environment, stdout=subprocess.DEVNULL)
    peaks: dict[int, int] = {}
    while process.poll() is None:
        with contextlib.suppress(psutil.Error):
            for each in (psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)):
                peaks[each.pid] = max(peaks.get(each.pid, 0), peak(each.pid))
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(process.returncode)
    return peaks


def peak(pid: int) -> int:
    """Return the peak of a process's resident set in bytes, 0 when it is gone."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return 0


def apart(first: Path, second: Path) -> float:
    """Return the relative L2 difference of two results, one weight in memory at a time."""
    squares = [0.0, 0.0]
    with safe_open(first, "np") as one, safe_open(second, "np") as other:
        for name in one.keys():  # noqa: SIM118 (a file, not a mapping)
            ours, theirs = one.get_tensor(name).astype(np.float64), other.get_tensor(name).astype(np.float64)
            squares[0] += float(((theirs - ours) ** 2).sum())
            squares[1] += float((ours**2).sum())
    return float((squares[0] / squares[1]) ** 0.5)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--layers", type=int, default=10)
    parser.add_argument("--width", type=int, default=2048)
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--only", choices=("whole", "parts"), help="one of both, without a comparison")
    parser.add_argument("options", nargs="*", help="of vlatool distill policy, after --")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        place = Path(made)
        os.environ |= {"VLATOOL_CACHE": str(place / "cache"), "VLATOOL_TRUST": str(place / "trusted.json")}
        policy = write_deep(place / "policy", BATCHED, layers=asked.layers, width=asked.width)
        run("prune", "neurons", str(policy), "--ratio", "0.5", "-o", str(place / "pruned"))
        train = ["distill", "policy", str(place / "pruned"), "--trust", str(policy), "--steps", str(asked.steps),
                 "--batch", "8", "--episodes", "0", "--student-episodes", "0", "--precision", "float32",
                 "--threads", "2", "--processes", "2", *asked.options]  # fmt: skip
        ways = {"whole": [], "parts": ["--shard"]}
        for name, more in ways.items() if asked.only is None else [(asked.only, ways[asked.only])]:
            begin = time.monotonic()
            peaks = sorted(run(*train, "-o", str(place / name), *more).values())[-2:]
            told = ", ".join(f"{bytes_ / 2**30:.2f} GiB" for bytes_ in reversed(peaks))
            print(f"{name}: {told} (first process, second), {time.monotonic() - begin:.0f} s", flush=True)
        if asked.only:
            return
        whole, parts = (place / name / "module/main.safetensors" for name in ("whole", "parts"))
        print(f"weights {whole.stat().st_size / 2**30:.2f} GiB, {apart(whole, parts):.1e} apart")


if __name__ == "__main__":
    main()
