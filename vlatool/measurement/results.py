"""Results of a benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from vlatool.measurement.answers import AnswerCheck, Memory
from vlatool.measurement.cold_start import ColdStart
from vlatool.runtime.engine_record import EngineRecord
from vlatool.telemetry import Summary


@dataclass(frozen=True)
class GraphEngine:
    """What runs a graph, as its session says.

    Args:
        graph: its name in the bundle.
        engine: engine of the runtime.
        version: version of the engine's library; empty when it does not tell.
        providers: execution providers of the library.
        computes_in: dtype of what is not quantized.
        macs_in: share of the multiplications in each precision, in words.
    """

    graph: str
    engine: str
    version: str
    providers: str
    computes_in: str
    macs_in: str


@dataclass(frozen=True)
class Phase:
    """A part of an inference: how often an action takes it, a call's median, and its share of the action's time."""

    name: str
    calls: int
    p50_ms: float
    share_percent: float


@dataclass(frozen=True)
class DutyMode:
    """Calls of one kind, between which a processor is busy or idle.

    Args:
        name: kind of the calls.
        rounds_ms: milliseconds of each call, by round.
    """

    name: str
    rounds_ms: tuple[tuple[float, ...], ...]

    @property
    def calls(self) -> int:
        """Number of calls."""
        return sum(map(len, self.rounds_ms))

    @property
    def p50_ms(self) -> float:
        """Median of all calls."""
        return median(value for values in self.rounds_ms for value in values)

    @property
    def max_ms(self) -> float:
        """The longest call."""
        return max(value for values in self.rounds_ms for value in values)


@dataclass(frozen=True)
class Pace:
    """What a control loop saw.

    Args:
        period_ms: between two ticks.
        wakeup_ms: delay with which the loop woke up for each tick that it slept until.
        age_ms: age of the observation behind the newest action at each tick.
        misses: ticks whose action came after the next tick was due.
        passed_over: ticks that began and ended while the policy computed.
        inferences: number of inferences that served all ticks.
        effective_sample_size: independent samples that the ticks are worth, since some share an inference.
    """

    period_ms: float
    wakeup_ms: tuple[float, ...]
    age_ms: tuple[float, ...]
    misses: int
    passed_over: int
    inferences: int
    effective_sample_size: float


@dataclass(frozen=True)
class PolicyRun:
    """What was measured of one policy.

    Args:
        name: name of its stage; with its directory where two are of one stage.
        blocks_ms: milliseconds of each call, by round.
        at_s: begin of each call, in seconds since the run began.
        engine: engine of the runtime.
        engines: engine of each graph; none in eager torch.
        record: what the engine ran in the warm-up, on what and in which precision; None in eager torch.
        golden_error: relative difference of the golden action; None without one.
        golden_explained: largest difference that rounding explains.
        reach: dtype -> 10^9 multiply-accumulates in a second of a large matrix product in the same engine
            (``reach.measure_reach``); none where it was not timed.
        answers: answers of the timed calls; None when they were not looked at.
        memory: None when it was not looked for, or cannot be.
        phases: parts of an inference; none when they were not timed.
        pace: pace of a control loop; None for calls back to back.
        duty: calls of each kind between which a processor is busy or idle; none when they were not timed.
        cold: cold of each fresh process.
        cold_error: why there is none, where one was asked for and failed.
    """

    name: str
    blocks_ms: tuple[tuple[float, ...], ...]
    at_s: tuple[float, ...]
    engine: str = ""
    engines: tuple[GraphEngine, ...] = ()
    record: EngineRecord | None = None
    golden_error: float | None = None
    golden_explained: float = 0.0
    reach: Mapping[str, float] = field(default_factory=dict)
    answers: AnswerCheck | None = None
    memory: Memory | None = None
    phases: tuple[Phase, ...] = ()
    pace: Pace | None = None
    duty: tuple[DutyMode, ...] = ()
    cold: tuple[ColdStart, ...] = ()
    cold_error: str = ""

    @property
    def samples(self) -> list[float]:
        """Milliseconds of all calls in the order in which they were taken."""
        return [value for block in self.blocks_ms for value in block]


@dataclass(frozen=True)
class Benchmark:
    """The result of a benchmark.

    Args:
        begun_s, ended_s: begin and end of the timed part, on the clock of ``telemetry``.
        cpu_s, wall_s, switches: user and system time, duration and involuntary context switches of the timed part.
        canary_ms: a fixed piece of work, timed now and then (``clock_drift``).
        policies: one for each bundle.
        host: state of the machine before the run (``before_run``).
        telemetry: telemetry of the board during the run.
        log: end of the standard error of the processes.
        target: other machine that was measured, if any: python, architecture, kernel and packages.
    """

    begun_s: float
    ended_s: float
    cpu_s: float
    wall_s: float
    switches: int
    canary_ms: tuple[float, ...]
    policies: tuple[PolicyRun, ...]
    host: Mapping[str, Any] = field(default_factory=dict)
    telemetry: Summary | None = None
    log: str = ""
    target: Mapping[str, Any] = field(default_factory=dict)
