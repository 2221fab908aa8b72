"""Readings of sensors under faults: how many are given as usable, and how many of those are stale.

Late, repeated, reordered and frozen samples, clocks that are set by up to an hour, drift, and stamps that are no time.

    python tests/validation/soak/stale_sensors.py --readings 100000
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "runtime"))
from _sensor_faults import Faults, stale_readings

TICKS = 1000


def main() -> None:
    """Print both numbers for each kind of fault, and for a buffer that believes each arrival."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readings", type=int, default=100_000, help="usable readings of each kind")
    parser.add_argument("--kinds", nargs="+", default=["all", *Faults.KINDS])
    options = parser.parse_args()
    failed = False
    for kind in options.kinds:
        for believe in (False, True):
            usable = stale = seed = 0
            while usable < (options.readings if not believe else options.readings // 100):
                more = stale_readings(np.random.default_rng(seed), kind, TICKS, believe=believe)
                usable, stale, seed = usable + more[0], stale + more[1], seed + 1
            failed |= bool(stale) and not believe
            print(f"{kind}: {usable:,} usable of {seed * TICKS:,} readings, {stale:,} stale"
                  f"{' (arrivals are believed)' if believe else ''}", flush=True)  # fmt: skip
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
