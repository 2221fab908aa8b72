"""Latency through the runtime, several policies interleaved in one run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from vlatool.benchmark._contest import Contestant, latency_measurements, run_interleaved, speedup, unique_names
from vlatool.benchmark._probe import cold_start
from vlatool.bundle import MANIFEST, Bundle
from vlatool.data import observations_for
from vlatool.errors import BundleError, GraphError, MissingExtra
from vlatool.export._torch_policy import torch_policy
from vlatool.host import fingerprint
from vlatool.hwselect._measured import WORK, whole_work
from vlatool.hwselect._workload import workload
from vlatool.report import Measurement, Report, Row
from vlatool.runtime.policy import Policy
from vlatool.stage import Context, Measure

if TYPE_CHECKING:
    from vlatool.profile import Profile

COLD_STARTS = 3


class Latency(Measure):
    """Measure inference latency through the runtime, batch 1, all policies interleaved in one run.

    A bundle that has no graph (a torch source) is measured in eager torch.
    """

    against: tuple[Path, ...] = Field((), description="further bundles, measured in the same run; compared with BUNDLE")
    iterations: int = Field(200, ge=20, description="inferences of each policy")
    warmup: int = Field(10, ge=1, description="inferences before the first that counts")
    threads: int = Field(1, ge=1, description="intra-op threads")
    engine: str = Field("", description="engine of the runtime; the one that each bundle was made for when empty")
    cold: bool = Field(True, description="also load each bundle in a fresh process: load time and peak memory")

    def inputs(self) -> tuple[Path, ...]:
        """The manifests of the further bundles; they hold the hash of every file."""
        return tuple(path / MANIFEST for path in self.against)

    def key(self, source_hash: str) -> str:
        """A latency belongs to the machine that it was measured on."""
        host = fingerprint()
        return super().key(f"{source_hash} {host.get('cpu')} {host.get('cores')} {host.get('kernel')}")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Every bundle can be opened."""
        for path in self.against:
            Bundle.open(path, verify=False)

    def run(self, source: Bundle, context: Context) -> Report:
        """Measure and return one row for each policy, the first is the reference of the speed-ups."""
        host = fingerprint()  # before the run itself loads the machine
        bundles = [source, *(Bundle.open(path) for path in self.against)]
        contestants = [self._open(bundle) for bundle in bundles]
        unique_names(contestants)
        run_interleaved(contestants, self.iterations, self.warmup, context)
        rows: list[Row] = []
        for contestant in contestants:
            context.tell("cold start of each in a fresh process", len(rows) / len(contestants))
            rows.append(self._row(contestant, contestants[0] if len(contestants) > 1 else None))
        p50 = rows[0].value("latency_p50")
        where = f"{host.get('cpu') or 'this host'}, {self.threads} thread{'s' if self.threads > 1 else ''}"
        summary = f"{rows[0].name}: {p50:.3g} ms median latency on {where}."
        title = f"Latency of {source.manifest.name}"
        return Report(
            "benchmark", title, summary=(summary,), rows=tuple(rows), environment=host, warnings=busy_warning(host)
        )

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

    def _row(self, contestant: Contestant, reference: Contestant | None) -> Row:
        samples = contestant.samples
        measurements = latency_measurements(samples)
        if reference is not None:
            measurements.append(speedup(contestant, reference))
        size = sum(
            record.bytes for path, record in contestant.bundle.manifest.files.items() if path.startswith("graphs/")
        )
        if contestant.bundle.manifest.graphs:
            measurements.append(Measurement("size", size / 1e6, "MB", note="graphs on disk"))
            if self.cold:
                measurements += self._cold(contestant)
        role = "baseline" if contestant is reference else "subject"
        tables = _work(contestant.bundle, contestant.policy.engine)
        return Row(contestant.name, role, measurements=tuple(measurements), raw={"latency_ms": samples}, details=tables)

    def _cold(self, contestant: Contestant) -> list[Measurement]:
        found = [cold_start(contestant.bundle.path, self.engine, self.threads) for _ in range(COLD_STARTS)]
        note = f"import of the runtime, load and one inference; median of {COLD_STARTS} fresh processes"
        totals = [each["import_ms"] + each["load_ms"] + each["first_ms"] for each in found]
        peaks = [each["peak_rss_mb"] for each in found]
        return [
            Measurement("peak_rss", float(np.median(peaks)), "MB", samples=COLD_STARTS, note=note),
            Measurement("cold_start", float(np.median(totals)), "ms", samples=COLD_STARTS, note=note),
        ]


def _work(bundle: Bundle, engine: str) -> dict[str, list[dict[str, Any]]]:
    """Return what one inference computes, from which predictions for the board can learn; nothing without onnx."""
    if not bundle.manifest.graphs:
        return {}
    try:
        return {WORK: [{**whole_work(workload(bundle)), "engine": engine}]}
    except (MissingExtra, GraphError):
        return {}


def busy_warning(host: Mapping[str, Any]) -> tuple[str, ...]:
    """Warn when other work was running: the load average says more than this process can have caused."""
    load, cores = host.get("load_average"), host.get("cores")
    if not load or not cores or load[0] <= max(1.5, 0.75 * cores):
        return ()
    return (
        f"this host was busy (load {load[0]:.1f} on {cores} cores): the latencies are those of a contended machine; "
        "ratios within the run still compare, absolute values do not; repeat on an idle machine",
    )


def set_torch_threads(threads: int) -> None:
    """Give eager torch as many threads as the engine gets."""
    import torch

    torch.set_num_threads(threads)
