"""Processor time of ONNX graphs in ONNX Runtime, in turns on one core, and their errors.

    python tests/validation/soak/graphs_in_turns.py DATA.npz FLOAT32.onnx OTHER.onnx ... --rounds 24

The first graph is the reference of ratios and errors. In each round each graph, in random order, runs four times on
observations of the recording (arrays by the names of the inputs, as they are fed but for the batch axis; in a file of
`make peers` those that begin with `evaluation.`, with it); the median of the last three counts. Processor time and not
wall time: a busy machine takes turns from all alike.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from statistics import median

import numpy as np
import onnxruntime

from vlatool.stats.intervals import quantile_interval

PEERS = "evaluation."


def main() -> int:
    """Measure, and print one line for each graph."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="recorded observations (data/evaluation.npz of a bundle)")
    parser.add_argument("graphs", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=24)
    given = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    sessions = [opened(path) for path in given.graphs]
    observed = observations(given.data, sessions[0])
    wanted = [run(sessions[0], feeds) for feeds in observed]
    errors = [
        np.mean([distance(run(session, feeds), right) for feeds, right in zip(observed, wanted, strict=True)])
        for session in sessions
    ]
    taken: list[list[float]] = [[] for _ in sessions]
    chance = np.random.default_rng(0)
    for number in range(given.rounds):
        for place in chance.permutation(len(sessions)):
            timed = []
            for turn in range(4):
                begun = time.process_time()
                run(sessions[place], observed[(number + turn) % len(observed)])
                timed.append((time.process_time() - begun) * 1e3)
            taken[place].append(median(timed[1:]))
    for path, error, times in zip(given.graphs, errors, taken, strict=True):
        ratios = np.array(taken[0]) / np.array(times)
        _, low, high = quantile_interval(ratios, 0.5)
        print(
            f"{path}: {median(times):.2f} ms, {median(ratios):.2f}x ({low or 0:.2f}-{high or 0:.2f}), error {error:.4f}"
        )
    return 0


def opened(path: Path) -> onnxruntime.InferenceSession:
    """Open a graph on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def observations(data: Path, session: onnxruntime.InferenceSession) -> list[dict[str, np.ndarray]]:
    """Return the feeds of each recorded observation."""
    names = [value.name for value in session.get_inputs()]
    with np.load(data, allow_pickle=False) as stored:
        if f"{PEERS}{names[0]}" in stored:
            arrays = {name: stored[PEERS + name] for name in names}
        else:
            arrays = {name: stored[name][:, None] for name in names}
    return [{name: array[number] for name, array in arrays.items()} for number in range(len(arrays[names[0]]))]


def run(session: onnxruntime.InferenceSession, feeds: dict[str, np.ndarray]) -> np.ndarray:
    """Return the first output for one observation."""
    found: np.ndarray = session.run(None, feeds)[0]
    return found


def distance(got: np.ndarray, right: np.ndarray) -> float:
    """Return the relative L2 difference."""
    return float(np.linalg.norm(got - right) / np.linalg.norm(right))


if __name__ == "__main__":
    raise SystemExit(main())
