"""How often an engine holds the weights of a bundle, in a process of its own for each.

python tests/validation/engines/weights_in_memory.py BUNDLE... [--engine ort_cpu openvino]

RSS and PSS of the process after ``load``, what of it no file backs (anonymous), and its peak, beside the size of the
graphs with their weights and the process before it loads; in 10^6 bytes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

CHILD = """
import json, sys
import numpy
import vlatool

def held():
    lines = [line.split() for line in open("/proc/self/smaps_rollup")]
    return {line[0].rstrip(":"): int(line[1]) * 1024 / 1e6 for line in lines if line[-1] == "kB"}

__import__({"ort_cpu": "onnxruntime"}.get(sys.argv[2], sys.argv[2]))
before = held()
policy = vlatool.load(sys.argv[1], engine=sys.argv[2], threads=1)
after = held()
peak = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps({
    "graphs": policy.bundle.graph_bytes / 1e6, "before": before["Rss"], "rss": after["Rss"], "pss": after["Pss"],
    "anonymous": after["Anonymous"], "peak": peak * 1024 / 1e6,
}))
"""
COLUMNS = ("graphs", "before", "rss", "pss", "anonymous", "peak")


def measured(bundle: Path, engine: str) -> dict[str, float]:
    """Return what a fresh process holds after it has loaded a bundle, in 10^6 bytes."""
    command = [sys.executable, "-c", CHILD, str(bundle), engine]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundles", nargs="+", type=Path)
    parser.add_argument("--engine", nargs="+", default=["ort_cpu", "openvino"])
    options = parser.parse_args()
    print(" | ".join(("bundle", "engine", *COLUMNS)))
    for bundle in options.bundles:
        for engine in options.engine:
            found = measured(bundle, engine)
            print(" | ".join((bundle.name, engine, *(f"{found[name]:.0f}" for name in COLUMNS))), flush=True)


if __name__ == "__main__":
    main()
