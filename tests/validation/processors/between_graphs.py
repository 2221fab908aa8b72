"""What it gains to leave tensors between graphs where an engine computed them, instead of copying them to the host.

    python tests/validation/processors/between_graphs.py BUNDLE --engine ort_cuda [--rounds 40]

Both ways take turns on the same sessions. Prints the median time of an inference, the ratio, and the largest relative
L2 distance of an action from the one that the processor computes.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import vlatool
from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.stats.intervals import quantile_interval

WARM_UP = 5
IN_PLACE, COPIED = "in place", "copied"


def main() -> None:
    """Take turns and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--engine", default="ort_cuda")
    parser.add_argument("--rounds", type=int, default=40)
    given = parser.parse_args()
    rows = list(observations_for(Bundle.open(given.bundle), 4))
    processor = vlatool.load(given.bundle, engine="ort_cpu", seed=0)
    expected = []
    for row in rows:
        processor.reset()
        expected.append(processor.infer(row).chunk)
    policy = vlatool.load(given.bundle, engine=given.engine, seed=0)
    sessions = policy.program.sessions.values()
    left = [(session._stays, session._passed) for session in sessions]
    times: dict[str, list[float]] = {IN_PLACE: [], COPIED: []}
    worst = dict.fromkeys(times, 0.0)
    for number in range(given.rounds + WARM_UP):
        for way, taken in times.items():
            for session, mine in zip(sessions, left, strict=True):
                session._stays, session._passed = mine if way == IN_PLACE else ({}, frozenset())
            policy.reset()
            start = time.perf_counter()
            action = policy.infer(rows[number % len(rows)]).chunk
            taken.append(time.perf_counter() - start)
            wanted = expected[number % len(rows)]
            worst[way] = max(worst[way], float(np.linalg.norm(action - wanted) / np.linalg.norm(wanted)))
    for way, taken in times.items():
        print(f"{way}: {1e3 * np.median(taken[WARM_UP:]):.2f} ms, at most {worst[way]:.2g} from the processor")
    ratio, low, high = quantile_interval(np.array(times[COPIED][WARM_UP:]) / times[IN_PLACE][WARM_UP:], 0.5)
    print(f"{COPIED} / {IN_PLACE}: {ratio:.2f} ({low or 0:.2f} to {high or np.inf:.2f})")


if __name__ == "__main__":
    main()
