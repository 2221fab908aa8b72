"""Where the time of an inference goes: encoding, each graph of the program, decoding."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlatool.measurement.results import Phase
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program, Session

ACTIONS = 60
FEWEST = 5
ENCODE, REST = "encode observation", "decode action and the rest"


class _Timed:
    """A session that notes how long each run takes."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.taken: list[float] = []

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        start = time.perf_counter_ns()
        outputs = self._session.run(feeds)
        self.taken.append((time.perf_counter_ns() - start) / 1e6)
        return outputs


def time_phases(policy: Policy, observations: Sequence[Mapping[str, Any]], seconds: float) -> list[Phase]:
    """Return the parts of an inference, in their order.

    Args:
        policy: left as it was.
        observations: observations, used in turns.
        seconds: time after which no further action begins, once ``FEWEST`` are timed.
    """
    sessions = {name: _Timed(session) for name, session in policy.program.sessions.items()}
    timed = Policy(policy.bundle, Program(policy.program.steps, sessions, seed=0), policy.engine)
    encoded: list[float] = []
    whole: list[float] = []
    end = time.monotonic() + seconds
    for number in range(ACTIONS):
        if number >= FEWEST and time.monotonic() > end:
            break
        start = time.perf_counter_ns()
        values = timed.encode(observations[number % len(observations)])
        encoded.append((time.perf_counter_ns() - start) / 1e6)
        timed.infer(values)
        whole.append((time.perf_counter_ns() - start) / 1e6)
    return _phases(whole, encoded, {name: session.taken for name, session in sessions.items()})


def _phases(whole: Sequence[float], encoded: Sequence[float], graphs: Mapping[str, Sequence[float]]) -> list[Phase]:
    actions = len(whole)
    sums = {ENCODE: np.array(encoded)}
    sums |= {name: np.array(taken).reshape(actions, -1).sum(1) for name, taken in graphs.items() if taken}
    sums[REST] = np.array(whole) - sum(sums.values())
    total = float(np.median(whole))
    phases = []
    for name, taken_ms in sums.items():
        calls, middle = len(graphs.get(name, whole)) // actions, float(np.median(taken_ms))
        phases.append(Phase(name, calls, round(middle / calls, 5), round(100 * middle / total, 1)))
    return phases
