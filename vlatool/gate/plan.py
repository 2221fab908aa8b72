"""Measurements that all claims of a gate together need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path


class Need(IntEnum):
    """Evidence that a claim looks at, in the order in which it is gathered: what is cheap first."""

    COLD_STARTS = 1
    RECORDINGS = 2
    EPISODES = 3
    TIMES = 4
    AGREEMENT = 5


@dataclass(frozen=True)
class Plan:
    """Measurements, and how they are made; each claim of a gate adds what its options say.

    Args:
        needs: evidence that any claim looks at.
        engine: name of the engine; the one that each bundle was made for when empty.
        also_threads: further numbers of threads at which latency is examined.
        warmup, pairs: calls of each bundle in a process that times both, before those that count, and of these.
        seconds: time after which such a process begins no further pair.
        timeout: seconds that any process may take.
        data: recorded observations that the gate file names.
        names: name in the spec -> name in them, where they differ.
        episodes: number of closed-loop episodes; 0 for none.
        policy: directory of the policy.yaml that names environment and tasks.
        disturb, strength: disturbances under which the episodes are played as well, and how strong they are.
        observations, answer_seconds: observations that both bundles answer, and the time after which none is added.
    """

    needs: frozenset[Need] = frozenset()
    engine: str = ""
    threads: int = 1
    also_threads: tuple[int, ...] = ()
    warmup: int = 20
    pairs: int = 150
    seconds: float = 10.0
    timeout: float = 1800.0
    data: Path | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    episodes: int = 0
    policy: Path | None = None
    disturb: tuple[str, ...] = ()
    strength: float = 1.0
    observations: int = 96
    answer_seconds: float = 60.0
