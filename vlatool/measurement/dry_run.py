"""The layers around a bundle and what they leave of a control period, measured on this machine without a robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.data import observations_for
from vlatool.errors import GateFailed
from vlatool.runtime import load
from vlatool.runtime.arguments import RECORD
from vlatool.runtime.engine_record import EngineRecord
from vlatool.runtime.interface import POLICY, Policy
from vlatool.runtime.loading import is_remote, open_remote
from vlatool.runtime.policy import BundlePolicy
from vlatool.runtime.rungs import PolicyRung
from vlatool.runtime.stack import Fallback, Stack, rate_factor
from vlatool.runtime.telemetry.cadence import Cadence, CadenceReport
from vlatool.runtime.two_parts import parts_of

OBSERVATIONS = 16


@dataclass(frozen=True)
class Spread:
    """Times in milliseconds.

    Args:
        p50: Median.
        p99: 99th percentile, the largest of fewer than a hundred.
        samples: Number of times.
    """

    p50: float
    p99: float
    samples: int

    @classmethod
    def of(cls, times: Sequence[float]) -> Spread:
        """Return the spread of some times."""
        return cls(float(np.median(times)), float(np.percentile(times, 99, method="higher")), len(times))


@dataclass(frozen=True)
class LayerNote:
    """One layer.

    Args:
        layer: Name of its class.
        does: What it does.
    """

    layer: str
    does: str


@dataclass(frozen=True)
class RungNote:
    """What may answer a control step.

    Args:
        source: What its actions say that they come from.
        time: Time of an inference; None where it needs none.
    """

    source: str
    time: Spread | None


@dataclass(frozen=True)
class DryRun:
    """What ``vlatool run --dry-run`` shows.

    Args:
        bundle: Name and version of the bundle.
        robot: Whose limits are kept; empty for none.
        period_ms: Control period of the robot.
        deadline_ms: Time in which a control step is answered.
        layers: Layers from the robot to the graphs, each with what it does.
        inference: Times of ``infer`` of the open bundle alone; of its fast part alone where it has a slow one.
        answer: Times of ``act`` of all layers, called at the rate of the robot.
        missed: Share of the control steps at which the policy had no action in time.
        engine: What the engine ran of the bundle, on what and in which precision.
        rungs: What answers a control step, in the order in which it is asked, each with the time of an answer.
        cadence: Where the time of the control steps went, all but the first.
        slow: Times of the slow part of a policy of two systems; None for another policy.
    """

    bundle: str
    robot: str
    period_ms: float
    deadline_ms: float
    layers: tuple[LayerNote, ...]
    inference: Spread
    answer: Spread
    missed: float
    engine: EngineRecord
    rungs: tuple[RungNote, ...]
    cadence: CadenceReport
    slow: Spread | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return {**asdict(self), "engine": self.engine.to_dict()}

    def check(self) -> None:
        """Refuse a policy that a robot would hardly ever hear; raises GateFailed."""
        if self.inference.p50 > self.deadline_ms:
            raise GateFailed(
                f"An inference of {self.bundle} takes {self.inference.p50:.3g} ms here (median); the deadline is "
                f"{self.deadline_ms:g} ms, so that the fallback would act most of the time.",
                "make it faster (vlatool optimize), execute more of each chunk with a controller that acts while the "
                "policy infers, or allow more time",
            )


def dry_run(
    path: Path,
    *,
    robot: str = "",
    deadline_ms: float | None = None,
    fallback: str | None = None,
    neutral: str = "",
    controllers: Sequence[str] = (),
    engine: str = "",
    threads: int | None = None,
    steps: int = 200,
) -> DryRun:
    """Build the layers around a bundle and play control steps on recorded or random observations.

    Args:
        deadline_ms: Time in which a control step is answered; the control period when None.
        steps: Number of control steps, and of inferences, that are measured.

    Raises:
        UsageError, SpecError, BundleError, GraphError: as ``vlatool.runtime.load`` does.
    """
    plain = load(path, engine=engine, threads=threads, seed=0, engine_proof=RECORD)
    rate = plain.spec.rate * rate_factor(controllers)
    period_ms = 1000 / rate
    limit_ms = period_ms if deadline_ms is None else deadline_ms
    second = None if fallback is None else _second(fallback, plain.spec, threads)
    cadence = Cadence(steps)
    options = Fallback(second, neutral=neutral)
    stack = load(path, engine=engine, threads=threads, seed=0, controllers=controllers, envelope=robot or None,
                 deadline_ms=limit_ms, fallback=options, telemetry=_without_first(cadence))  # fmt: skip
    if not isinstance(stack, Stack):
        raise TypeError("a deadline makes a stack")
    bundle = Bundle.open(path)
    observations = observations_for(bundle, OBSERVATIONS)
    inference, slow = _spreads(plain, observations, steps)
    others = [] if second is None else [Spread.of(_times(second.infer, observations, steps))]
    answers = play_paced(stack, observations, steps, rate)
    stack.close()
    return DryRun(
        f"{bundle.manifest.name} {bundle.manifest.version}",
        robot,
        period_ms,
        limit_ms,
        tuple(LayerNote(type(layer).__name__, _what(layer)) for layer in stack.layers),
        inference,
        Spread.of(answers),
        cadence.report().misses / steps,
        plain.engine_record(),
        tuple(_rungs(stack, [inference, *others])),
        cadence.report(),
        slow,
    )


def _spreads(policy: BundlePolicy, observations: Sequence[Any], count: int) -> tuple[Spread, Spread | None]:
    """Return the times of an inference, and of the slow part where there is one, which the first leaves out."""
    if policy.slow is None:
        return Spread.of(_times(policy.infer, observations, count)), None
    slow, fast = parts_of(policy)
    fast.latent = slow.run(observations[0])
    return Spread.of(_times(fast.infer, observations, count)), Spread.of(_times(slow.run, observations, count))


def _second(named: str, spec: PolicySpec, threads: int | None) -> Policy:
    """Return the second policy: a bundle, or one that another machine serves."""
    return open_remote(named, spec) if is_remote(named) else load(named, threads=threads, seed=0)


def _times(call: Any, observations: Sequence[Any], count: int) -> list[float]:
    """Return the milliseconds of calls, the first ones apart."""
    times = []
    for number in range(count + len(observations)):
        begin = time.perf_counter_ns()
        call(observations[number % len(observations)])
        times.append((time.perf_counter_ns() - begin) / 1e6)
    return times[len(observations) :]


def play_paced(stack: Stack, observations: Sequence[Any], count: int, rate: float) -> list[float]:
    """Play control steps at the robot's rate in Hz; return the milliseconds of each from its call, but the first."""
    times, begin = [], time.monotonic()
    for number in range(count + 1):
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        called = time.perf_counter_ns()
        stack.act(observations[number % len(observations)], scheduled=begin + number / rate)
        times.append((time.perf_counter_ns() - called) / 1e6)
    return times[1:]


def _without_first(cadence: Cadence) -> Callable[[Any], None]:
    return lambda record: cadence(record) if record.step else None


def _what(layer: Any) -> str:
    """Return what a layer does, as its class says it."""
    return (type(layer).__doc__ or "").strip().partition("\n")[0]


def _rungs(stack: Stack, spreads: Sequence[Spread | None]) -> list[RungNote]:
    """Return the source of each rung's actions and the time that it takes, where it infers."""
    left = iter(spreads)
    rungs = [] if stack.ladder is None else stack.ladder.rungs
    return [RungNote(rung.source or POLICY, next(left) if isinstance(rung, PolicyRung) else None) for rung in rungs]
