"""Bundles exchanged while a control loop runs: no action is of two bundles, and what the slots cost in each inference.

Usage: python tests/validation/updates/update_exchanges.py --ticks 100000

One thread goes back and forth between two bundles without end, each opened by ONNX Runtime beside the one that runs;
the loop infers without a pause. Each chunk must hold one value alone. Then the time of an inference is compared with
that of the same bundle without a store, in turns: committed, and on trial.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
from _slots import OBSERVATION, TRIAL, bundle_of, install

from vlatool.deployment.pointer import Trial
from vlatool.deployment.slot_policy import SlotPolicy
from vlatool.deployment.store import Store
from vlatool.runtime import load


def exchanged(folder: Path, ticks: int) -> tuple[int, int, int]:
    """Return how many chunks of each bundle there were, and how many were of both."""
    store = Store(folder / "store")
    for value in (1, 2):
        install(store, bundle_of(folder / f"bundle {value}", value), trial=None)
    policy, end = SlotPolicy(store, threads=1), threading.Event()

    def turn() -> None:
        while not end.is_set():
            store.roll_back("next")
            policy.refresh()

    thread = threading.Thread(target=turn)
    thread.start()
    counts = {1.0: 0, 2.0: 0}
    mixed = 0
    for _ in range(ticks):
        values = set(policy.infer(OBSERVATION).chunk.ravel().tolist())
        mixed += len(values) > 1
        counts[values.pop()] += 1
    end.set()
    thread.join()
    print(f"{ticks} inferences during {store.read().change} changes of the pointer")
    return (*counts.values(), mixed)


def cost_us(folder: Path, trial: Trial | None, pairs: int) -> list[float]:
    """Return percentiles 50, 99 and 99.9 of the time in us of an inference without and with slots, in turns."""
    store = Store(folder / f"store {trial is None}")
    bundles = [bundle_of(folder / f"cost {trial is None} {value}", value) for value in (1, 2)]
    for bundle in bundles:
        install(store, bundle, trial=trial)
    policies = [load(bundles[1].path, threads=1), SlotPolicy(store, threads=1)]
    times = np.empty((pairs, 2))
    for pair in range(pairs):
        for side in (0, 1) if pair % 2 else (1, 0):
            start = time.perf_counter_ns()
            policies[side].infer(OBSERVATION)
            times[pair, side] = (time.perf_counter_ns() - start) / 1e3
    return np.percentile(times, (50, 99, 99.9), axis=0).T.ravel().round(1).tolist()


def main() -> int:
    """Print the counts and times; 1 when an action was of two bundles, or a bundle never answered."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=100_000)
    parser.add_argument("--pairs", type=int, default=20_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        one, two, mixed = exchanged(Path(name), given.ticks)
        print(f"{one} of the first bundle, {two} of the second, {mixed} of both", flush=True)
        endless = Trial(10**9, 0, TRIAL.latency_ms * 1e6, 1e6)
        for label, trial in (("committed", None), ("on trial", endless)):
            print(f"{label}: p50, p99, p99.9 in us without, with slots: {cost_us(Path(name), trial, given.pairs)}")
    return int(mixed > 0 or not one or not two)


if __name__ == "__main__":
    sys.exit(main())
