"""Hold `vlatool benchmark` against a bare measurement of the same graph, as onnxruntime_perf_test makes one.

    python tests/validation/soak/bare_agrees.py BUNDLE --rounds 10

Rounds alternate between two fresh processes: ``vlatool benchmark`` on the bundle, and ONNX Runtime alone, which calls
``InferenceSession.run`` on one set of inputs, back to back for as long. Printed are the ratios of their medians, and of
their 90th percentiles, round by round and in the middle: of whole inferences (which encode and decode), and of the
graph within them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import median

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.runtime.policy import Policy

BARE = """
import json, sys, time
import numpy as np
import onnxruntime as ort
options = ort.SessionOptions()
options.intra_op_num_threads, options.inter_op_num_threads = 1, 1
session = ort.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
feeds = dict(np.load(sys.argv[2]))
for _ in range(10):
    session.run(None, feeds)
taken, end = [], time.perf_counter() + float(sys.argv[3])
while time.perf_counter() < end:
    start = time.perf_counter_ns()
    session.run(None, feeds)
    taken.append((time.perf_counter_ns() - start) / 1e6)
print(json.dumps(list(np.percentile(taken, [50, 90]))))
"""


def main() -> int:
    """Alternate, and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=3.0)
    given = parser.parse_args()
    bundle = Bundle.open(given.bundle)
    graph = bundle.file(next(iter(bundle.manifest.graphs.values())).file)
    feeds = inputs(bundle, given.bundle.parent / f"{given.bundle.name}-feeds.npz")
    ratios: dict[str, list[float]] = {"p50": [], "p90": [], "graph p50": []}
    for number in range(given.rounds):
        found = {}
        for which in ("bare", "whole") if number % 2 else ("whole", "bare"):
            found[which] = bare(graph, feeds, given.seconds) if which == "bare" else whole(given.bundle, given.seconds)
        for name in ratios:
            if found["whole"][name] is not None:  # a percentile without a bound is not given
                ratios[name].append(found["whole"][name] / found["bare"][name])
        print(", ".join(f"{name} {values[-1]:.3f}" for name, values in ratios.items() if values), flush=True)
    print("middle: " + ", ".join(f"{name} {median(values):.3f}" for name, values in ratios.items() if values))
    return 0


def inputs(bundle: Bundle, path: Path) -> Path:
    """Write what the graph is fed for one observation."""
    policy = Policy.open(bundle, threads=1, seed=0)
    encoded = policy.encode(observations_for(bundle, 1)[0])
    step = bundle.manifest.program[0]
    np.savez(path, **{name: encoded[value] for name, value in step.feeds.items()})
    return path


def bare(graph: Path, feeds: Path, seconds: float) -> dict[str, float]:
    """Measure ONNX Runtime alone."""
    command = [sys.executable, "-c", BARE, str(graph), str(feeds), str(seconds)]
    p50, p90 = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return {"p50": p50, "p90": p90, "graph p50": p50}


def whole(bundle: Path, seconds: float) -> dict[str, float]:
    """Measure through the runtime."""
    command = [
        sys.executable,
        "-m",
        "vlatool",
        "benchmark",
        str(bundle),
        "--duration",
        str(seconds),
        "--no-cold",
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    row = json.loads(done.stdout)["rows"][0]
    values = {each["name"]: each["value"] for each in row["measurements"]}
    phases = {each["phase"]: each for each in row["details"]["time by phase"]}
    graph = next(line for name, line in phases.items() if not name.startswith(("encode", "decode")))
    return {"p50": values["latency_p50"], "p90": values["latency_p90"], "graph p50": graph["p50 ms"]}


if __name__ == "__main__":
    sys.exit(main())
