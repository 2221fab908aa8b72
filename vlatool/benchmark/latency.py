"""Latency, memory, energy and what a board tells meanwhile, through the runtime, several policies in one run."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field, PrivateAttr

from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.bundle.module_bundle import export_command
from vlatool.errors import BundleError, GraphError, MissingExtra, TargetError, UsageError
from vlatool.files.messages import from_json, to_json
from vlatool.files.printable import amount, one_line
from vlatool.graph.workload import WORKLOAD_TABLE, Workload, summarize_workload, workload
from vlatool.graph.zeros import zero_share
from vlatool.machine.host import fingerprint
from vlatool.measurement import agent
from vlatool.measurement.interleaved import MAX_CALLS
from vlatool.measurement.jobs import LatencyJob, Limits
from vlatool.measurement.reach import LIKELY_SHARE, POSSIBLE, REPEATS, SIZE, share_of_reach
from vlatool.measurement.results import Benchmark, PolicyRun
from vlatool.measurement.rows import measurements, raw, sustained_rows, tables
from vlatool.measurement.validity import findings, validity
from vlatool.measures import resources, with_derived
from vlatool.measures import tables as titles
from vlatool.measures.latency import DEADLINE_MISSES, GMACS, LATENCY_P50, REACH_SHARE, SPEEDUP
from vlatool.report import Finding, Measurement, Report, Row
from vlatool.runtime.engine import engine_class
from vlatool.stage.base import Context, Measure
from vlatool.stage.identity import with_identity

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

COLD_STARTS = 3
LOG_LINES = 40
CALLS, FEWEST_TICKS = 200, 20
LONGEST_S = 86_400
THIS_HOST = "this host"
SPARSE = 0.2
"""Share of zeros, above those of the first policy, from which a policy counts as sparse."""
MIN_GAIN = 1.05
"""Speed-up that its interval must lie above before a policy is said to gain by its zeros."""


class Latency(Measure):
    """Measure latency, memory and energy through the runtime, batch 1, in a fresh process.

    Back to back, or with --rate as a control loop: then everything counts from the moment at which a tick was due.
    With --against all policies take turns in one run. A bundle without a graph (a torch source) is measured in eager
    torch.
    """

    remotely: ClassVar[bool] = True

    against: tuple[Path, ...] = Field((), description="further bundles, measured in the same run; compared with BUNDLE")
    iterations: int | None = Field(
        None, ge=20, le=MAX_CALLS, description="inferences of each policy, at least; 200, and with --rate 20, if unset"
    )
    duration: float = Field(10.0, ge=0, le=LONGEST_S, description="seconds that each policy is timed for, at least")
    warmup: int = Field(10, ge=1, description="inferences before the first that counts")
    rate: float = Field(0.0, ge=0, le=10_000, description="pace of a control loop in Hz; back to back when 0")
    duty_cycle: float = Field(
        0.0, ge=0, le=10_000,
        description="also time calls at this rate in Hz, idle in between, beside a busy loop and single shots; 0: not",
    )  # fmt: skip
    sustained: float = Field(
        0.0, ge=0, le=LONGEST_S, description="run each for this many seconds, and compare the end with the start"
    )
    threads: int = Field(1, ge=1, le=1024, description="intra-op threads")
    pin: str = Field("", description="processors to run on, such as 0-3 or 2,4; all when empty")
    engine: str = Field("", description="engine of the runtime; the one that each bundle was made for when empty")
    cold: bool = Field(True, description="also load each bundle in fresh processes: cold start, and memory by part")
    phase: bool = Field(True, description="also time the parts of an inference: encoding, each graph, decoding")
    answers: bool = Field(True, description="also check for answers that change during the run or come from memory")
    reach: bool = Field(
        True, description="also time a large matrix product in the same engine, and report the share of its speed"
    )
    cores: int = Field(0, ge=0, le=4096, description="processors that the policy may use; all when 0")
    memory_mb: float = Field(
        0.0, ge=0, le=1e9, description="memory that its process may use in MB (10^6 bytes); all when 0"
    )
    emulate: bool = Field(
        False, description="take --cores and --memory-mb from --profile: what does not fit fails here"
    )
    mode: str = Field("", description="power mode of --profile that --emulate takes; its default mode when empty")
    _board: str = PrivateAttr("")

    def inputs(self) -> tuple[Path, ...]:
        """The manifests of the further bundles; they hold the hash of every file."""
        return tuple(path / MANIFEST for path in self.against)

    def key(self, source_hash: str) -> str:
        """A latency belongs to the machine that it was measured on."""
        host = fingerprint()
        return super().key(f"{source_hash} {host.get('cpu')} {host.get('cores')} {host.get('kernel')}")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Every bundle can be opened, and the options fit each other."""
        for name in ("duration", "rate", "duty_cycle", "sustained", "memory_mb"):
            if not math.isfinite(getattr(self, name)):
                raise UsageError(
                    f"--{name.replace('_', '-')} is {getattr(self, name)}; allowed: a number from 0.",
                    "give a number that is not negative",
                )
        if self.rate and self.against:
            raise UsageError(
                "--rate paces one policy; measure the further ones in runs of their own.",
                "leave --against out, or leave --rate out to compare them back to back",
            )
        if self.rate * self.duration > MAX_CALLS:
            raise UsageError(
                f"--rate {self.rate:g} for {self.duration:g} s are {self.rate * self.duration:,.0f} ticks; "
                f"allowed: {MAX_CALLS:,}, each of which is kept.",
                f"give a lower --rate, or a --duration of at most {MAX_CALLS / self.rate:.3g} s",
            )
        if self.rate and (self.iterations or FEWEST_TICKS) > self.rate * LONGEST_S:
            raise UsageError(
                f"--rate {self.rate:g} takes more than a day for {self.iterations or FEWEST_TICKS} ticks.",
                "give a higher --rate, or fewer --iterations",
            )
        if self.sustained and self.rate:
            raise UsageError(
                "--sustained calls back to back; with --rate pass --duration.",
                "leave --sustained out, and give its seconds as --duration",
            )
        if self.emulate and profile is None:
            raise UsageError("--emulate needs a board.", "name it: --profile NAME (see: vlatool profiles list)")
        if self.mode and not self.emulate:
            raise UsageError("--mode is the power mode that --emulate takes.", "pass --emulate, too")
        processors(self.pin)
        for path in self.against:
            Bundle.open(path, verify=False)

    def on(self, board: Profile | None) -> Self:
        """Return the stage with the limits of a board, where it is to be emulated.

        Raises:
            UsageError: when more threads are asked for than the board has cores.
            ProfileError: when it has no such power mode.
        """
        if board is None or not self.emulate:
            return self
        mode = board.mode(self.mode or None)
        cores = int(mode.cores.get("cpu", board.units["cpu"].cores.value if "cpu" in board.units else 0))
        if cores and self.threads > cores:
            raise UsageError(
                f"--threads is {self.threads}; {board.name} has {cores} processors in this mode.",
                f"give --threads {cores} or fewer, or another --mode of the board",
            )
        memory = 1e3 * board.usable_memory_gb.value
        limited = self.model_copy(update={"cores": self.cores or cores, "memory_mb": self.memory_mb or memory})
        limited._board = board.name
        return limited

    def run(self, source: Bundle, context: Context) -> Report:
        """Measure and return one row for each policy, the first is the reference of the speed-ups."""
        bundles = [source, *(Bundle.open(path) for path in self.against)]
        for bundle in bundles:
            if not bundle.manifest.graphs and "factory" not in bundle.manifest.source:
                raise BundleError(
                    f"{bundle.path} has nothing to run.", f"export it first: {export_command(bundle.path)}"
                )
            if self.memory_mb and not bundle.manifest.graphs:
                raise UsageError(f"The memory of eager torch is not limited: {bundle.path} has no graph.", "export it")
        job = self._job(bundles)
        if context.measure_remotely is None:
            return self._report(bundles, job, agent.measure(job, context.progress), THIS_HOST)
        answer = context.measure_remotely(to_json(job), [bundle.path for bundle in bundles], context.progress)
        try:
            measured = from_json(Benchmark, answer, "answer")
            where = str(measured.host.get("board") or measured.host.get("cpu") or "the target")
            return self._report(bundles, job, measured, where)
        except (LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise TargetError(
                f"What the target measured makes no sense ({type(error).__name__}: {one_line(str(error), 120)}).",
                "look at that machine: whether it is the one that you mean, and what runs there",
            ) from error

    def _job(self, bundles: Sequence[Bundle]) -> LatencyJob:
        return LatencyJob(
            bundles=tuple(str(bundle.path.resolve()) for bundle in bundles),
            engine=self.engine,
            threads=self.threads,
            iterations=self.iterations or (FEWEST_TICKS if self.rate else CALLS),
            duration=max(self.duration, self.sustained),
            warmup=self.warmup,
            rate=self.rate,
            phases=self.phase,
            cold=COLD_STARTS if self.cold else 0,
            check=self.answers,
            limits=Limits(processors(self.pin), self.cores, self.memory_mb),
            duty_cycle=self.duty_cycle,
            reach=self.reach and not self.memory_mb,  # what a policy may take is not for a product
        )

    def _report(self, bundles: Sequence[Bundle], job: LatencyJob, run: Benchmark, where: str) -> Report:
        reference, *others = run.policies
        if self.memory_mb or self.cores:
            where += f", limited{f' as {self._board}' if self._board else ''}"
        rows = []
        for bundle, policy in zip(bundles, run.policies, strict=True):
            numbers = measurements(run, policy, reference if others else None, self.rate, self.duty_cycle)
            numbers += sustained_rows(policy.samples) if self.sustained else []
            if bundle.manifest.graphs:
                numbers.append(resources.SIZE.measurement(bundle.graph_bytes / 1e6, note="graphs on disk"))
            work = _work(bundle)
            numbers += _arithmetic(work, policy)
            details = tables(run, policy, not others)
            details |= {WORKLOAD_TABLE: [{**summarize_workload(work), "engine": policy.engine}]} if work else {}
            if policy is reference and (lines := run.log.strip().splitlines()):
                details[titles.LOG] = [{"line": line} for line in lines[-LOG_LINES:]]
            role = "baseline" if policy is reference and others else "subject"
            placed = tuple(replace(number, where=where) for number in numbers)
            row = Row(policy.name, role, "", placed, raw(run, policy, not others), details)
            rows.append(with_identity(with_derived(row), bundle))
        seen = (
            *findings(run, job, bool(self.sustained)),
            *self._limited(run.host, where),
            *_sparse(bundles, rows, run),
            *_beyond(rows),
        )
        valid = validity(seen)
        return Report(
            "benchmark",
            f"Latency of {bundles[0].manifest.name}",
            verdict="inconclusive" if valid == "invalid" else "info",
            summary=(self._sentence(rows, run.host, valid, seen),),
            rows=tuple(rows),
            limits={"hz": self.rate} if self.rate else {},
            environment={**run.host, "run": self._run_settings(), **({"target": run.target} if run.target else {})},
            validity=valid,
            findings=seen,
        )

    def _sentence(self, rows: Sequence[Row], host: Mapping[str, Any], valid: str, seen: Sequence[Finding]) -> str:
        if valid == "invalid":
            return f"The measurement is invalid: {seen[0].reason}."
        where = f"{host.get('cpu') or 'this host'}, {amount(self.threads, 'thread')}"
        row, others = rows[0], rows[1:]
        text = f"{row.name}: {_ms(row)} median latency on {where}"
        for other in others:
            text += f"; {other.name}: {_ms(other)} ({other.value(SPEEDUP):.3g}x as fast)"
        if self.rate:
            misses = row.value(DEADLINE_MISSES)
            late = f"{misses:.2%} of the ticks are late" if misses else "no tick is late"
            text = f"{row.name} at {self.rate:g} Hz: {late}, {_ms(row)} median from the tick to "
            text += f"its action, on {where}"
        return text + "."

    def _run_settings(self) -> dict[str, Any]:
        """Return how it was measured, for the environment of the report: what makes two reports differ."""
        options = {"threads": self.threads, "rate_hz": self.rate, "pin": self.pin, "cores": self.cores,
                "memory_limit_mb": self.memory_mb, "emulates": self._board}  # fmt: skip
        return {name: value for name, value in options.items() if value}

    def _limited(self, host: Mapping[str, Any], where: str) -> list[Finding]:
        if not (self.cores or self.memory_mb):
            return []
        usable = int(host.get("cores") or self.cores)
        what = [f"{min(self.cores, usable)} processors"] * bool(self.cores)
        what += [f"{self.memory_mb:,.0f} MB of memory"] * bool(self.memory_mb)
        board = f" as {self._board}" if self._board else ""
        speed = f"the speed is that of {where.split(',')[0]}"
        notes = [Finding("note", f"emulation{board}: {' and '.join(what)}; {speed}")]
        if self.cores > usable:
            effect = "suspect" if self.threads > usable else "note"
            lacks = f"{self._board or 'the limit'} has {self.cores} processors, and this machine {usable}"
            notes.append(Finding(effect, lacks, "measure on a machine with as many"))
        return notes


def processors(text: str) -> tuple[int, ...]:
    """Return the numbers of ``0-3,6``; none for an empty text; raises UsageError when it is not such a list."""
    if not text:
        return ()
    if not re.fullmatch(r"\d{1,4}(-\d{1,4})?(,\d{1,4}(-\d{1,4})?)*", text):
        raise UsageError(
            f"--pin is {text!r}; allowed: processors such as 0-3 or 2,4.", "write numbers and ranges, such as --pin 0-3"
        )
    ends = [[int(end) for end in part.split("-")] for part in text.split(",")]
    numbers = sorted({number for end in ends for number in range(end[0], end[-1] + 1)})
    if not numbers:
        raise UsageError(
            f"--pin is {text!r}, which names no processor; allowed: such as 0-3 or 2,4.",
            "write numbers and ranges in rising order, such as --pin 0-3",
        )
    return tuple(numbers)


def _ms(row: Row) -> str:
    """Return the median latency with three digits, or with all before the point."""
    value = row.value(LATENCY_P50)
    return f"{value:.3g} ms" if value < 1000 else f"{value:,.0f} ms"


def _sparse(bundles: Sequence[Bundle], rows: Sequence[Row], run: Benchmark) -> Iterator[Finding]:
    """Say of each policy with more zeros than the first one whether the engine gains by them, as was measured."""
    dense = zero_share(bundles[0]) if len(bundles) > 1 else 1.0
    for bundle, row, policy in list(zip(bundles, rows, run.policies, strict=True))[1:]:
        share = zero_share(bundle) if dense < 1 else 0.0
        if share < dense + SPARSE:
            continue
        speedup = row.get(SPEEDUP)
        if speedup is None:
            continue
        gained = speedup.low is not None and speedup.low > MIN_GAIN
        titles = ", ".join(dict.fromkeys(str(engine_class(graph.engine).title) for graph in policy.engines))
        verdict = "gains by them" if gained else "multiplies them like other numbers: nothing is faster"
        yield Finding(
            "note",
            f"{share:.0%} of the weights of {row.name} are zero, and it is {speedup.value:.3g}x as fast as "
            f"{rows[0].name} in this run: {titles} {verdict}",
            "" if gained else "for speed, remove whole units: vlatool prune structured",
        )


def _beyond(rows: Sequence[Row]) -> Iterator[Finding]:
    """Say where a policy seems to be faster than its work at the speed of the large product."""
    for row in rows:
        found = row.get(REACH_SHARE)
        if found is None or found.value <= LIKELY_SHARE:
            continue
        what = f"{row.name} seems to do its work {found.value:,.3g} times as fast as the large product"
        if found.value > POSSIBLE:
            why = "the engine leaves out most of what the graph counts (it is constant, or nothing reads it)"
            yield Finding("suspect", f"{what}: {why}", "count on the latency alone, not on GMAC/s")
        else:
            why = "other work slowed that product down, or the engine has a faster kernel for other layers"
            yield Finding("note", f"{what}: {why}", "repeat on an idle machine")


def _work(bundle: Bundle) -> Workload | None:
    """Return what one inference computes, from which predictions for the board can learn; None without onnx."""
    if not bundle.manifest.graphs:
        return None
    try:
        return workload(bundle)
    except (MissingExtra, GraphError):
        return None


def _arithmetic(work: Workload | None, policy: PolicyRun) -> list[Measurement]:
    """Return how much a policy computes in a second, and which share that is of a large product in the same engine."""
    latency = median(policy.samples) / 1e3 if policy.samples else 0.0
    if work is None or not policy.reach or work.unknown or latency <= 0:
        return []
    total, product = sum(work.macs.values()), ", ".join(f"{dtype} {gmacs:.3g}" for dtype, gmacs in policy.reach.items())
    each = f"{total / 1e9:.3g} GMAC in one inference"
    numbers = [GMACS.measurement(total / latency / 1e9, samples=len(policy.samples), note=each)]
    share = share_of_reach(work.macs, policy.reach, latency)
    note = f"time that the same work takes at the speed of a product of {SIZE}^3 in this run (GMAC/s: {product})"
    return numbers if share is None else [*numbers, REACH_SHARE.measurement(share, samples=REPEATS, note=note)]
