"""What the runtime adds to the engine's own run()."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for
from vlatool.errors import UsageError
from vlatool.machine.host import fingerprint
from vlatool.measures import series, with_derived
from vlatool.measures.latency import BARE_RUN_P50, OVERHEAD_IN_TURN_P50, OVERHEAD_P50
from vlatool.report import Report, Row
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import draw, schedule_arrays
from vlatool.stage.base import Context, Measure
from vlatool.stage.identity import with_identity
from vlatool.stats.intervals import quantile_interval

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


ROUND = 40
"""Consecutive calls of one kind; the first round of each kind warms up and is dropped."""


class Overhead(Measure):
    """Measure what ``infer`` adds to the engine's bare ``run()`` on the same inputs.

    Rounds of consecutive calls of one kind, as a controller makes, alternate with rounds of the other; the
    overhead is the median over pairs of rounds of the difference of their medians. A second figure is the harder case:
    single calls of both kinds in turn, so that each finds the processor's caches as the other left them.
    """

    runs_graphs: ClassVar[bool] = True

    iterations: int = Field(2000, ge=100, description="calls of each kind")
    threads: int = Field(1, ge=1, description="intra-op threads")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The program is one graph that runs once, so that there is one bare call to compare with."""
        if source is not None and (len(source.manifest.program) != 1 or source.manifest.program[0].repeat != 1):
            raise UsageError(
                "The overhead is measured on a policy of one graph that runs once for each inference.",
                "vlatool benchmark latency measures all of what infer() does, the program of several graphs included",
            )
        if source is not None and source.manifest.engine not in ("", DEFAULT_ENGINE):
            raise UsageError(
                f"The overhead is measured on ONNX Runtime; the bundle is for {source.manifest.engine}.",
                "make the bundle with --layout ort, or measure it with vlatool benchmark latency",
            )

    def run(self, source: Bundle, context: Context) -> Report:
        """Return the median of the paired differences in microseconds."""
        policy = Policy.open(source, threads=self.threads, seed=0)
        observations = observations_for(source, 16)
        step = policy.program.steps[0]
        session = getattr(policy.program.sessions[step.graph], "_session")  # noqa: B009
        own = _own_values(step)
        values = [{**policy.encode(observation), **own} for observation in observations]
        feeds = [{name: encoded[value] for name, value in step.feeds.items()} for encoded in values]

        def run(fed: dict[str, Any]) -> Any:
            return session.run(None, fed)

        bare: list[float] = []
        whole: list[float] = []
        rounds = -(-self.iterations // ROUND)
        for number in range(rounds + 1):
            context.progress("measuring rounds", number / (rounds + 1))
            for kind in (0, 1) if number % 2 else (1, 0):
                if kind:
                    whole.append(_median_us(policy.infer, observations))
                else:
                    bare.append(_median_us(run, feeds))
        context.progress("measuring calls in turn", None)
        in_turn = _in_turn_us(policy.infer, observations, run, feeds, rounds * ROUND)
        differences = np.array(whole[1:]) - np.array(bare[1:])
        return self._report(source, differences, in_turn, float(np.median(bare[1:])))

    def _report(self, source: Bundle, differences: np.ndarray, in_turn: list[float], bare_us: float) -> Report:
        value, low, high = quantile_interval(differences, 0.5)
        note = f"infer() minus bare run(), medians of alternating rounds of {ROUND} calls"
        turn, turn_low, turn_high = quantile_interval(in_turn, 0.5)
        beside = "infer() minus bare run(), single calls in turn"
        count = len(in_turn)
        measurements = (
            OVERHEAD_P50.measurement(value, samples=len(differences), low=low, high=high, note=note),
            OVERHEAD_IN_TURN_P50.measurement(turn, samples=count, low=turn_low, high=turn_high, note=beside),
            BARE_RUN_P50.measurement(bare_us, samples=len(differences), note="engine alone"),
        )
        text = f"infer() adds {value:.1f} us (median) to a bare run() of {bare_us:.0f} us"
        text += f"; {turn:.1f} us when calls of both kinds take turns."
        row = with_derived(
            Row(source.manifest.name, measurements=measurements, raw={series.OVERHEAD: differences.tolist()})
        )
        return Report("benchmark", f"Overhead of the runtime on {source.manifest.name}", summary=(text,),
                      rows=(with_identity(row, source),),
                      environment=fingerprint())  # fmt: skip


def _own_values(step: ProgramStep) -> dict[str, Any]:
    """Return what the program itself feeds to a step: kept values of a new episode, noise, and the schedule's first."""
    random = np.random.default_rng(0)
    values: dict[str, Any] = {name: draw(wanted, random) for name, wanted in step.noise.items()}
    values |= {name: np.zeros(kept["shape"], kept.get("dtype", "float32")) for name, kept in step.keep.items()}
    return values | {name: numbers[0] for name, numbers in schedule_arrays(step).items()}


def _median_us(call: Callable[[Any], Any], arguments: Sequence[Any]) -> float:
    taken = []
    for index in range(ROUND):
        argument = arguments[index % len(arguments)]
        start = time.perf_counter_ns()
        call(argument)
        taken.append((time.perf_counter_ns() - start) / 1e3)
    return float(np.median(taken))


def _in_turn_us(
    infer: Callable[[Any], Any],
    observations: Sequence[Any],
    run: Callable[[Any], Any],
    feeds: Sequence[Any],
    pairs: int,
) -> list[float]:
    """Return infer minus run of each pair, in microseconds; who goes first alternates."""
    calls = ((run, feeds), (infer, observations))
    differences = []
    for pair in range(pairs):
        taken = [0.0, 0.0]
        for kind in (0, 1) if pair % 2 else (1, 0):
            call, arguments = calls[kind]
            argument = arguments[pair % len(arguments)]
            start = time.perf_counter_ns()
            call(argument)
            taken[kind] = (time.perf_counter_ns() - start) / 1e3
        differences.append(taken[1] - taken[0])
    return differences
