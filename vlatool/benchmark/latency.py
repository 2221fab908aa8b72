"""Latency through the runtime, several policies interleaved in one run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from vlatool.benchmark._probe import cold_start
from vlatool.bundle import MANIFEST, Bundle
from vlatool.data import observations_for
from vlatool.errors import BundleError
from vlatool.export._torch_policy import torch_policy
from vlatool.host import fingerprint
from vlatool.report import Measurement, Report, Row
from vlatool.runtime.policy import Policy
from vlatool.stage import Context, Measure
from vlatool.statistics import quantile_interval

if TYPE_CHECKING:
    from vlatool.profile import Profile

BLOCKS = 20
"""Rounds in which every policy takes its turn; ratios are taken within a round, so that a slow phase hits all alike."""


@dataclass
class Contestant:
    """One policy in the run: its bundle, how it is opened, and the milliseconds of each inference."""

    name: str
    bundle: Bundle
    policy: Policy
    observations: list[dict[str, Any]]
    blocks: list[list[float]] = field(default_factory=list)

    @property
    def samples(self) -> list[float]:
        """All milliseconds in the order in which they were taken."""
        return [value for block in self.blocks for value in block]


class Latency(Measure):
    """Measure inference latency through the runtime, batch 1, all policies interleaved in one run.

    A bundle that has no graph (a torch source) is measured in eager torch.
    """

    against: tuple[Path, ...] = Field((), description="further bundles, measured in the same run; compared with BUNDLE")
    iterations: int = Field(200, ge=20, description="inferences of each policy")
    warmup: int = Field(10, ge=1, description="inferences before the first that counts")
    threads: int = Field(1, ge=1, description="intra-op threads")
    engine: str = Field("ort_cpu", description="engine of the runtime")
    cold: bool = Field(True, description="also load each bundle in a fresh process: load time and peak memory")

    def inputs(self) -> tuple[Path, ...]:
        """The manifests of the further bundles; they hold the hash of every file."""
        return tuple(path / MANIFEST for path in self.against)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Every bundle can be opened."""
        for path in self.against:
            Bundle.open(path, verify=False)

    def run(self, source: Bundle, context: Context) -> Report:
        """Measure and return one row for each policy, the first is the reference of the speed-ups."""
        bundles = [source, *(Bundle.open(path) for path in self.against)]
        contestants = [self._open(bundle) for bundle in bundles]
        unique_names(contestants)
        self._measure(contestants, context)
        rows = []
        for contestant in contestants:
            context.tell("cold start of each in a fresh process", len(rows) / len(contestants))
            rows.append(self._row(contestant, contestants[0]))
        p50 = rows[0].value("latency_p50")
        host = fingerprint()
        where = f"{host.get('cpu') or 'this host'}, {self.threads} thread{'s' if self.threads > 1 else ''}"
        summary = f"{rows[0].name}: {p50:.3g} ms median latency on {where}."
        title = f"Latency of {source.manifest.name}"
        return Report("benchmark", title, summary=(summary,), rows=tuple(rows), environment=host)

    def _open(self, bundle: Bundle) -> Contestant:
        manifest = bundle.manifest
        if manifest.graphs:
            policy = Policy.open(bundle, engine=self.engine, threads=self.threads, seed=0)
        elif "factory" in manifest.source:
            policy = torch_policy(bundle)
            set_torch_threads(self.threads)
        else:
            raise BundleError(f"{bundle.path} has nothing to run.")
        stage = str(manifest.made_by.get("stage", "policy")).rpartition(".")[2]
        name = {"torch_module": "torch eager", "onnx": "float32"}.get(stage, stage)
        return Contestant(name, bundle, policy, observations_for(bundle, 32))

    def _measure(self, contestants: Sequence[Contestant], context: Context) -> None:
        for contestant in contestants:
            for index in range(self.warmup):
                contestant.policy.infer(contestant.observations[index % len(contestant.observations)])
        each = max(1, self.iterations // BLOCKS)
        order = np.random.default_rng(0)
        for block in range(BLOCKS):
            context.tell("measuring latency", block / BLOCKS)
            for index in order.permutation(len(contestants)):
                contestants[int(index)].blocks.append(_timed(contestants[int(index)], each))

    def _row(self, contestant: Contestant, reference: Contestant) -> Row:
        samples = contestant.samples
        measurements = [*latency_measurements(samples), speedup(contestant, reference)]
        size = sum(
            record.bytes for path, record in contestant.bundle.manifest.files.items() if path.startswith("graphs/")
        )
        if contestant.bundle.manifest.graphs:
            measurements.append(Measurement("size", size / 1e6, "MB", note="graphs on disk"))
            if self.cold:
                measurements += self._cold(contestant)
        role = "baseline" if contestant is reference else "subject"
        return Row(contestant.name, role, measurements=tuple(measurements), raw={"latency_ms": samples})

    def _cold(self, contestant: Contestant) -> list[Measurement]:
        found = cold_start(contestant.bundle.path, self.engine, self.threads)
        note = "fresh process: import of the runtime, load and one inference"
        total = found["import_ms"] + found["load_ms"] + found["first_ms"]
        return [
            Measurement("peak_rss", found["peak_rss_mb"], "MB", samples=1, note=note),
            Measurement("cold_start", total, "ms", samples=1, note=note),
        ]


def _timed(contestant: Contestant, count: int) -> list[float]:
    found = []
    done = len(contestant.blocks) * count
    for index in range(count):
        observation = contestant.observations[(done + index) % len(contestant.observations)]
        start = time.perf_counter_ns()
        contestant.policy.infer(observation)
        found.append((time.perf_counter_ns() - start) / 1e6)
    return found


def latency_measurements(samples: Sequence[float]) -> list[Measurement]:
    """Return p50, p90, p99 and max in ms; a percentile whose upper bound the samples do not reach is left out."""
    found = []
    for name, quantile in (("p50", 0.5), ("p90", 0.9), ("p99", 0.99)):
        value, low, high = quantile_interval(samples, quantile)
        if high is not None:
            found.append(Measurement(f"latency_{name}", value, "ms", samples=len(samples), low=low, high=high))
    return [*found, Measurement("latency_max", max(samples), "ms", samples=len(samples))]


def speedup(contestant: Contestant, reference: Contestant) -> Measurement:
    """Return reference median / own median, with the order-statistic interval of the ratios within rounds."""
    ratios = [
        float(np.median(base) / np.median(own)) for base, own in zip(reference.blocks, contestant.blocks, strict=True)
    ]
    value = float(np.median(reference.samples) / np.median(contestant.samples))
    _, low, high = quantile_interval(ratios, 0.5)
    low, high = (min(low, value) if low else low), (max(high, value) if high else high)
    note = f"ratio of medians to {reference.name}, interleaved"
    return Measurement("speedup", value, "x", samples=len(contestant.samples), low=low, high=high, note=note)


def unique_names(contestants: Sequence[Contestant]) -> None:
    """Tell contestants of the same stage apart by their directories."""
    names = [contestant.name for contestant in contestants]
    for contestant in contestants:
        if names.count(contestant.name) > 1:
            contestant.name = f"{contestant.name} ({contestant.bundle.path.name})"


def set_torch_threads(threads: int) -> None:
    """Give eager torch as many threads as the engine gets."""
    import torch

    torch.set_num_threads(threads)
