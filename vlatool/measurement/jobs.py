"""What the processes of a benchmark are asked to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Limits:
    """What the measured processes may use.

    Args:
        cpus: numbers of the processors; every one that the process may use anyway when empty.
        cores: number of processors, the first ones; all when 0.
        memory_mb: memory of a process in MB (10^6 bytes); 0 for no limit.
        cgroup: directory of the control group that holds the limit; empty when the process limits itself.
    """

    cpus: tuple[int, ...] = ()
    cores: int = 0
    memory_mb: float = 0.0
    cgroup: str = ""

    def __bool__(self) -> bool:
        return bool(self.cpus or self.cores or self.memory_mb)


NO_LIMITS = Limits()


@dataclass(frozen=True)
class LatencyJob:
    """A benchmark of the latency.

    Args:
        bundles: directories; the first is the reference of ratios.
        engine: engine of the runtime; that which each bundle was made for when empty.
        threads: intra-op threads.
        iterations: calls of each that count, at least.
        duration: seconds that the calls of each last, at least; with ``iterations`` the later of both.
        warmup: calls before the first that counts.
        rate: ticks in a second of a control loop; 0 calls back to back. One bundle only.
        phases: also time the parts of an inference.
        cold: fresh processes for the cold start of each.
        check: also look for answers that differ between runs, and for answers from memory.
        limits: limits of every process.
        duty_cycle: also time calls at this rate in Hz, idle in between, beside a busy loop and single shots; 0 for not.
        reach: also time a large matrix product in what each policy computes in.
    """

    bundles: tuple[str, ...]
    engine: str = ""
    threads: int = 1
    iterations: int = 200
    duration: float = 0.0
    warmup: int = 10
    rate: float = 0.0
    phases: bool = False
    cold: int = 0
    check: bool = True
    limits: Limits = NO_LIMITS
    reach: bool = False
    duty_cycle: float = 0.0


@dataclass(frozen=True)
class WorkerJob:
    """What the agent asks of the worker; ``named`` are folders whose code may run (``trust.named_folders``)."""

    job: LatencyJob
    named: Any = field(default_factory=list)


@dataclass(frozen=True)
class ColdStartJob:
    """One cold start.

    Args:
        bundle: directory.
        engine: engine of the runtime; that which the bundle was made for when empty.
        threads: intra-op threads.
        begun_ns: start of the process, on the clock that all processes of a machine share.
        observations: file of observations (``save_drawn``) to infer on after the golden one; none when empty.
    """

    bundle: str
    engine: str
    threads: int
    begun_ns: int
    observations: str = ""
