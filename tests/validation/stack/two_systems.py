"""A policy of two systems at its control rate: the fast part answers in its time while the slow part takes far longer.

    vlatool export DIR -o out/two        # DIR: sample_models/vla-flow with 'slow: {max_age_ms: 1000}' at its prefix
    python tests/validation/stack/two_systems.py out/two --repeat 20 --seconds 30

The steps of the slow part are repeated, so that they take longer, in the engine and on its threads. Prints the time of
both parts alone, and of the control steps with the slow part in a thread and, beside it, with both parts at each
inference; how old the values of the slow part were, and what answered.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.runtime.policy import Policy
from vlatool.runtime.stack import Fallback, Stack, build_stack
from vlatool.runtime.two_parts import parts_of

WAYS = {"slow part in a thread": "dual_rate:thread=true", "both at each inference": "dual_rate:every=1"}


def slowed(path: Path, repeat: int, rate: float | None, max_age_ms: float | None) -> Bundle:
    """Return a bundle whose slow part runs so many times, at another control rate."""
    bundle = Bundle.open(path)
    manifest = bundle.manifest
    oldest = {} if max_age_ms is None else {"max_age_ms": max_age_ms}
    program = tuple(
        replace(step, repeat=step.repeat * repeat, slow={**step.slow, **oldest}) if step.slow else step
        for step in manifest.program
    )
    spec = manifest.spec if rate is None else replace(manifest.spec, control_hz=rate)
    return replace(bundle, manifest=replace(manifest, spec=spec, program=program))


def times_ms(call: Callable[[Any], Any], seen: list[Any], count: int) -> np.ndarray[Any, Any]:
    """Return the milliseconds of calls one after the other."""
    times = []
    for number in range(count):
        begin = time.perf_counter()
        call(seen[number % len(seen)])
        times.append((time.perf_counter() - begin) * 1e3)
    return np.array(times)


def play(stack: Stack, seen: list[Any], rate: float, steps: int) -> dict[str, Any]:
    """Play control steps at a rate; return the times of their answers, from when each was to begin, and the sources."""
    answers, ages, sources = [], [], Counter[str]()
    begin = time.monotonic()
    for number in range(steps):
        scheduled = begin + number / rate
        time.sleep(max(0.0, scheduled - time.monotonic()))
        stack.act(seen[number % len(seen)], scheduled=scheduled)
        answers.append((time.monotonic() - scheduled) * 1e3)
        sources[stack.origin.source] += 1
        if stack.origin.source == "policy":
            ages.append(stack.origin.latent_age_ms)
    stack.close()
    return {"answers": np.array(answers), "ages": np.array(ages, float), "sources": dict(sources)}


def spread(times: np.ndarray[Any, Any]) -> str:
    """Return the median, the 99th percentile and the largest of some times."""
    if not len(times):
        return "none"
    return f"p50 {np.median(times):.2f} ms, p99 {np.percentile(times, 99):.2f} ms, at most {times.max():.2f} ms"


def run(bundle: Bundle, seconds: float, deadline_ms: float | None = None) -> list[dict[str, Any]]:
    """Play both ways and print what came out."""
    policy = Policy.open(bundle, threads=1, seed=0)
    seen, rate = list(observations_for(bundle, 16)), policy.spec.rate
    limit_ms = 0.9e3 / rate if deadline_ms is None else deadline_ms
    slow, fast = parts_of(policy)
    fast.latent = slow.run(seen[0])
    print(f"slow part alone: {spread(times_ms(slow.run, seen, 10))}")
    print(f"fast part alone: {spread(times_ms(fast.infer, seen, 100))}; control period {1e3 / rate:g} ms")
    played = []
    start = np.zeros(policy.spec.action.robot_width)
    for title, named in (
        ("slow part in a thread", "dual_rate:thread=true"),
        ("both at each inference", "dual_rate:every=1"),
    ):
        stack = build_stack(Policy.open(bundle, threads=1, seed=0), controllers=[named, "chunked:execute=1"],
                            deadline_ms=limit_ms, fallback=Fallback(start=start))  # fmt: skip
        played.append(play(stack, seen, rate, round(seconds * rate)))
        result = played[-1]
        late = (result["answers"] > limit_ms + 1).mean()
        print(f"{title}: answers within {limit_ms:g} ms: {spread(result['answers'])}, {late:.1%} over it by 1 ms; "
              f"values {spread(result['ages'])} old; {result['sources']}")  # fmt: skip
    return played


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--repeat", type=int, default=1, help="runs of the slow part in the place of one")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--deadline-ms", type=float, default=None)
    parser.add_argument("--hz", type=float, default=None, help="another control rate than that of the spec")
    parser.add_argument("--max-age-ms", type=float, default=None, help="in the place of what the program says")
    given = parser.parse_args()
    run(slowed(given.bundle, given.repeat, given.hz, given.max_age_ms), given.seconds, given.deadline_ms)
