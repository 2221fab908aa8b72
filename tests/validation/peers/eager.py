"""How much faster bundles are than the policy in eager torch: one process, one call of each in turn.

    python tests/validation/peers/eager.py my-policy out/float32 out/int8 --rounds 20 --threads 1

The policy runs its torch modules through the same program as the bundles run their graphs (what is computed once there
is computed once here); all have as many threads, and see the same observations. Prints the median time of each, the
ratio to torch with its 95 % interval, the relative L2 distance of the actions, and the share of the time of an
inference that is not spent inside the engine.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import vlatool
from vlatool.data import observations_for
from vlatool.module.torch_policy import torch_policy
from vlatool.sources import source_bundle, source_stage
from vlatool.stage.base import Context
from vlatool.stage.run import cache_directory
from vlatool.stats.intervals import quantile_interval

EAGER = "torch eager"


class Clock:
    """Adds up the time inside the sessions of a policy."""

    def __init__(self, policy: Any) -> None:
        self.seconds = 0.0
        for name, session in policy.program.sessions.items():
            policy.program.sessions[name] = _Timed(session, self)


class _Timed:
    def __init__(self, session: Any, clock: Clock) -> None:
        self._session, self._clock = session, clock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def run(self, feeds: Any) -> Any:
        start = time.perf_counter()
        try:
            return self._session.run(feeds)
        finally:
            self._clock.seconds += time.perf_counter() - start


def main() -> None:
    """Take turns and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("bundles", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    source = source_bundle(source_stage(given.policy), cache_directory(), Context()).bundle
    policies: dict[str, Any] = {EAGER: torch_policy(source, seed=0)}
    policies |= {str(path): vlatool.load(path, threads=given.threads, seed=0) for path in given.bundles}
    clocks = {name: Clock(policy) for name, policy in policies.items()}
    observations = observations_for(source, 4)
    times: dict[str, list[float]] = {name: [] for name in policies}
    apart: dict[str, list[float]] = {name: [] for name in policies}
    for number in range(given.rounds + 1):  # the first round warms up
        actions = {}
        for name, policy in policies.items():
            policy.reset()
            start = time.perf_counter()
            with torch.inference_mode():
                actions[name] = policy.infer(observations[number % len(observations)]).chunk
            times[name].append(time.perf_counter() - start)
        for name, action in actions.items():
            expected = actions[EAGER]
            apart[name].append(float(np.linalg.norm(action - expected) / np.linalg.norm(expected)))
    print(f"{given.threads} thread(s), {given.rounds} rounds; {source.manifest.name}")
    for name in policies:
        mine = np.array(times[name][1:])
        ratios = np.array(times[EAGER][1:]) / mine
        ratio, low, high = quantile_interval(ratios, 0.5)
        outside = 1 - clocks[name].seconds / sum(times[name])
        speed = f"{1e3 * np.median(mine):.1f} ms, {ratio:.2f}x ({low or 0:.2f}-{high or np.inf:.2f}) as fast as torch"
        print(f"{name}: {speed}, actions {max(apart[name]):.2g} apart, {outside:.3%} of the time outside the sessions")


if __name__ == "__main__":
    main()
