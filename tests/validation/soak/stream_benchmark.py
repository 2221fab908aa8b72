"""Quantize a Llama-shaped policy of 6.7 billion parameters and print the speed and the peak memory.

    python tests/validation/soak/stream_benchmark.py --folder /data/llama --make    # writes 13.5 GB of shards once
    python tests/validation/soak/stream_benchmark.py --folder /data/llama [-- --bits 4 --block 32]

The time is that of the whole command, from starting Python to the bundle on the disk, fsync included. The memory is
the sum of VmHWM, the most that a process had resident, over the command and the processes that it starts.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

PARAMETERS = 6_738_415_616
TARGET_SPEED, TARGET_RSS = 80e6, 1.5e9


def peak_bytes(pid: int, found: dict[int, int], ended: threading.Event) -> None:
    """Follow VmHWM of a process and its children until it ends: pid -> bytes."""
    while not ended.wait(0.05):
        with contextlib.suppress(OSError):
            children = [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
            for each in (pid, *children):
                for line in Path(f"/proc/{each}/status").read_text().splitlines():
                    if line.startswith("VmHWM:"):
                        found[each] = int(line.split()[1]) * 1024


def measure(policy: Path, scratch: Path, options: list[str]) -> tuple[float, float, int, str]:
    """Run the command from nothing; return wall seconds, CPU seconds, peak bytes and what it printed."""
    out = scratch / "out"
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "vlatool", "quantize", "weight-only", str(policy), "-o", str(out), *options]
    environment = {**os.environ, "VLATOOL_CACHE": str(scratch / "cache")}
    found: dict[int, int] = {}
    ended = threading.Event()
    start = time.perf_counter()
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    watch = threading.Thread(target=peak_bytes, args=(process.pid, found, ended))
    watch.start()
    printed = process.communicate()[0]
    seconds = time.perf_counter() - start
    ended.set()
    watch.join()
    if process.returncode:
        raise SystemExit(f"the command failed, exit {process.returncode}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, used.ru_utime + used.ru_stime, sum(found.values()), printed


def parameters_of(policy: Path) -> int:
    """Count the weights by the headers of the shards."""
    from vlatool.weights.shards import read_shards

    return sum(tensor.count for tensor in read_shards(policy, "*.safetensors").values())


def main() -> int:
    """Make the policy, or measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="where the policy is")
    parser.add_argument("--make", action="store_true", help="write the policy")
    parser.add_argument("--layers", type=int, default=None, help="with --make: layers, in the place of 32")
    parser.add_argument("--keep", type=Path, default=None, help="keep the bundle here")
    parser.add_argument("options", nargs="*", help="options of `vlatool quantize weight-only`, after --")
    given = parser.parse_args()
    if given.make:
        sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
        from _llama import write_llama

        start = time.perf_counter()
        count = write_llama(given.folder, layers=given.layers)
        print(f"{count / 1e9:.3f} G parameters written in {time.perf_counter() - start:.0f} s")
        return 0
    count = parameters_of(given.folder)
    with tempfile.TemporaryDirectory(prefix=".stream-", dir=given.folder.parent) as scratch:
        seconds, cpu, peak, printed = measure(given.folder, Path(scratch), given.options)
        print(printed, end="")
        written = sum(path.stat().st_size for path in (Path(scratch) / "out").rglob("*") if path.is_file())
        if given.keep:
            shutil.move(Path(scratch) / "out", given.keep)
    figures = {"parameters": count, "seconds": round(seconds, 1), "cpu_seconds": round(cpu, 1)}
    figures |= {"parameters_per_s": round(count / seconds), "load_average": os.getloadavg()[0]}
    print(json.dumps({**figures, "peak_rss_bytes": peak, "written_bytes": written, "cores": os.cpu_count()}))
    met = count / seconds >= TARGET_SPEED and peak <= TARGET_RSS
    print(f"targets: {TARGET_SPEED / 1e6:g} M/s and {TARGET_RSS / 1e9:g} GB: {'met' if met else 'missed'}")
    return 0 if met or count < PARAMETERS else 1


if __name__ == "__main__":
    sys.exit(main())
