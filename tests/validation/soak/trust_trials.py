"""Try many times whether a measurement that must not be trusted is caught, and whether one that can be is left alone.

    python tests/validation/soak/trust_trials.py --trials 100

A policy that answers from memory, one that returns garbage once it is called often, one that stalls for 50 ms in every
1,000th call, and an honest one, each measured through the benchmark's own loop; and traces of a board that throttles
by 5 to 40 % at a random moment, against traces of one that does not.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "measurement"))

from _policies import Garbage, Memoising, Stalling

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import observations_for
from vlatool.measurement.clock_drift import drift
from vlatool.measurement.interleaved import Contestant, latency_measurements
from vlatool.measurement.jobs import LatencyJob
from vlatool.measurement.paced import run_paced
from vlatool.measurement.validity import MAX_DRIFT, findings
from vlatool.measurement.worker import measure
from vlatool.runtime.policy import Action, Policy


def main() -> int:
    """Run the trials and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--trials", type=int, default=100)
    given = parser.parse_args()
    bundle = Bundle.open(given.bundle)
    policy = Policy.open(bundle, threads=1, seed=0)
    counts: dict[str, int] = {
        "honest, invalid": sum(invalid(policy, bundle) for _ in range(given.trials)),
        "from memory, invalid": sum(invalid(Memoising(policy), bundle) for _ in range(given.trials)),
        "garbage under load, invalid": sum(invalid(Garbage(policy, 60), bundle) for _ in range(given.trials)),
        "stalls in p99.9 and max": sum(stalls_show() for _ in range(given.trials)),
        "stalls in p99.9, max and misses of a loop": sum(stalls_show_in_a_loop(seed) for seed in range(given.trials)),
    }
    draw = np.random.default_rng(0)
    counts["throttled traces found, of 200"] = sum(throttled(draw, True) for _ in range(200))
    counts["steady traces found throttled, of 500"] = sum(throttled(draw, False) for _ in range(500))
    print(json.dumps({name: int(count) for name, count in counts.items()}, indent=1))
    return 0


def invalid(policy: Policy, bundle: Bundle) -> bool:
    """Say whether a short run of a policy is found invalid."""
    contestant = Contestant("x", bundle, policy, observations_for(bundle, 16))
    job = LatencyJob((str(bundle.path),), iterations=200, warmup=2)
    found = findings(measure([contestant], job, lambda *_: None), job)
    return any(each.effect == "invalid" for each in found)


class Quick:
    """A policy that does next to nothing, so that many calls take little time."""

    spec = PolicySpec((TensorSpec("x", (1, 1)),), (TensorSpec("action", (1, 1, 1)),), control_hz=100)
    engine, golden_error = "none", None
    bundle = SimpleNamespace(manifest=SimpleNamespace(graphs={}))

    def infer(self, observation: dict[str, object]) -> Action:
        """Return the same action."""
        return Action(np.zeros((1, 1), np.float32), ("x",), 0.0, 0, {})

    def reset(self) -> None:
        """Forget nothing."""


def stalls_show() -> bool:
    """Say whether stalls of 50 ms in every 1,000th call show in the 99.9th percentile and the maximum."""
    quick = Quick()
    contestant = Contestant("x", quick.bundle, Stalling(quick, 1000), [{"x": 0.0}])
    job = LatencyJob(("x",), iterations=20_000, warmup=0, check=False)
    samples = measure([contestant], job, lambda *_: None).policies[0].samples
    told = {each.name: each for each in latency_measurements(np.random.default_rng(0).permutation(samples))}
    return told["latency_p99.9"].high >= 50 and told["latency_max"].value >= 50


def stalls_show_in_a_loop(seed: int) -> bool:
    """Say whether such stalls show in a loop at 100 Hz, in a time of its own (80 s of it)."""
    draw, now = np.random.default_rng(seed), [0.0]

    def passes(seconds: float) -> None:
        now[0] += seconds

    class Slow(Quick):
        def infer(self, observation: dict[str, object]) -> Action:
            passes(draw.uniform(1e-3, 4e-3))
            return super().infer(observation)

    policy = Stalling(Slow(), 1000, sleep=passes)
    ticks = run_paced(policy, [{"x": 0.0}], 100.0, 8000, clock=lambda: now[0], sleep=passes)
    told = {
        each.name: each for each in latency_measurements(ticks.response_ms, most=ticks.pace().effective_sample_size)
    }
    return told["latency_p99.9"].value >= 20 and told["latency_max"].value >= 50 and ticks.misses >= 7 * 5


def throttled(draw: np.random.Generator, really: bool) -> bool:
    """Say whether a trace of canaries is found to have moved."""
    trace = 0.25 * (1 + np.abs(draw.normal(0, 0.01, 21)))
    if really:
        trace[draw.integers(5, 16) :] *= 1 + draw.uniform(0.07, 0.4)
    return bool(abs(drift(list(trace))) > MAX_DRIFT)


if __name__ == "__main__":
    sys.exit(main())
