"""Import, load and first action, beside importing numpy and ONNX Runtime and opening one session, in fresh processes.

    python tests/validation/stack/startup.py BUNDLE --runs 20

The two kinds take turns; the ratio is of the medians. The processor's time is that of the whole process.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.runtime import load

BARE = """
import numpy, onnxruntime
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession({graph!r}, options, providers=["CPUExecutionProvider"])
session.run(None, dict(numpy.load({feeds!r})))
"""
OURS = """
import numpy, vlatool
policy = vlatool.load({bundle!r}, threads=1{layers})
observation = {{name: value if value.dtype.kind != "U" else str(value) for name, value in numpy.load({seen!r}).items()}}
policy.{method}(observation)
"""


def main() -> None:
    """Print medians and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--deadline-ms", type=float)
    options = parser.parse_args()
    policy, bundle = load(options.bundle, threads=1), Bundle.open(options.bundle)
    observation = observations_for(bundle, 1)[0]
    step = policy.program.steps[0]
    encoded = policy.encode(observation)
    with tempfile.TemporaryDirectory() as folder:
        feeds, seen = Path(folder) / "feeds.npz", Path(folder) / "seen.npz"
        np.savez(feeds, **{name: encoded[value] for name, value in step.feeds.items()})
        np.savez(seen, **{name: np.asarray(value) for name, value in observation.items()})
        graph = str(bundle.path / bundle.manifest.graphs[step.graph].file)
        layers = f", deadline_ms={options.deadline_ms}" if options.deadline_ms else ""
        codes = {
            "numpy, onnxruntime, one session and run": BARE.format(graph=graph, feeds=str(feeds)),
            "vlatool.load and the first action": OURS.format(
                bundle=str(bundle.path), seen=str(seen), layers=layers, method="act" if layers else "infer"
            ),
        }
        medians = _medians(codes, options.runs)
    for name, (passed, used) in medians.items():
        print(f"{name}: {passed:.0f} ms, {used:.0f} ms of the processor (medians of {options.runs})")
    bare, ours = medians.values()
    print(f"ratio: {ours[0] / bare[0]:.2f}, of the processor's time {ours[1] / bare[1]:.2f}")


def _medians(codes: dict[str, str], runs: int) -> dict[str, list[float]]:
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in codes}
    for run in range(runs + 1):
        for name in list(codes) if run % 2 else reversed(list(codes)):
            begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, "-c", codes[name]], check=True)
            passed, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
            used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            taken[name].append((passed * 1e3, used * 1e3))
    return {name: np.median(times[1:], axis=0).tolist() for name, times in taken.items()}


if __name__ == "__main__":
    main()
