"""Workers on one core that take turns: blocks of all contestants alternate in seeded random order."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _limits import LIMITS, dtype_of
from _ours import COMMANDS, MARK, bundle_of, make
from _peers import PEERS, REFERENCE
from _workload import Array, PeersError, Workload, environment, last_words, run_child

WORKER = Path(__file__).with_name("_worker.py")
CLOCKS = ("cpu", "wall")
Tell = Callable[[str], None]


@dataclass
class Contestant:
    """One row of the table.

    Args:
        name: What the table calls it.
        opens: What the worker is told to open.
        failed: Why it has no figures; empty when it has.
        engine: What runs it: ``ort_cpu``, ``openvino``, empty for others.
        dtypes: Dtype -> share of its multiply-accumulates.
        group: Contestants of one group took turns; the reference is in each.
        rounds: Clock -> median milliseconds of each round.
        reference: Clock -> the reference's, in the same rounds.
    """

    name: str
    opens: str
    failed: str = ""
    error: float = float("nan")
    peak_mb: float = float("nan")
    load_s: float = float("nan")
    engine: str = ""
    dtypes: dict[str, float] = field(default_factory=dict)
    group: int = -1
    rounds: dict[str, list[float]] = field(default_factory=lambda: {clock: [] for clock in CLOCKS})
    reference: dict[str, list[float]] = field(default_factory=lambda: {clock: [] for clock in CLOCKS})

    @property
    def ours(self) -> bool:
        return self.name.startswith(MARK)


class Worker:
    """A process that holds one contestant."""

    def __init__(self, workload: Workload, contestant: Contestant, core: int, log: Path) -> None:
        self.contestant = contestant
        self.log = log
        command = [sys.executable, str(WORKER), "--folder", str(workload.folder), "--workload", workload.name]
        command += ["--core", str(core), contestant.opens]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as stream:
            self.process = subprocess.Popen(
                command, env=environment(), text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream
            )

    def ask(self, request: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send a request (none: wait for the first answer) and return the answer.

        Raises:
            PeersError: when the worker says that it failed, or is gone.
        """
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        line = ""
        try:
            if request is not None:
                self.process.stdin.write(json.dumps(request) + "\n")
                self.process.stdin.flush()
            line = self.process.stdout.readline()
        except BrokenPipeError:
            pass
        if not line:
            code = self.process.wait()
            raise PeersError(f"the worker ended with {code}: {last_words(self.log.read_text(errors='replace'))}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise PeersError(answer["error"])
        return answer

    def close(self) -> None:
        """End the process."""
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def build(workload: Workload, contestant: Contestant) -> None:
    """Make the contestant's model where it is not there yet; a failure is noted in its row."""
    try:
        if contestant.name in LIMITS:
            return
        if not contestant.ours:
            if not PEERS[contestant.name].built(workload):
                command = [sys.executable, str(WORKER), "--build", "--folder", str(workload.folder)]
                run_child([*command, "--workload", workload.name, contestant.name], "the build")
        elif contestant.name.removeprefix(MARK) in COMMANDS:
            make(workload, contestant.name.removeprefix(MARK))
            contestant.opens = f"{MARK}{bundle_of(workload, contestant.name.removeprefix(MARK))}"
    except PeersError as error:
        contestant.failed = str(error)


@dataclass
class Contest:
    """The run of one workload.

    Args:
        workload: The policy.
        core: The processor core that all workers share.
        rounds: Rounds of each group.
        block: Timed inferences of one contestant in one round.
        memory_mb: Resident memory beyond which a new group begins.
        tell: Takes lines of progress.
    """

    workload: Workload
    core: int
    rounds: int
    block: int
    memory_mb: float
    tell: Tell
    _expected: Array | None = None

    def run(self, contestants: Iterable[Contestant]) -> None:
        """Open, check and time all contestants, in as few groups as fit in memory."""
        waiting = [each for each in contestants if not each.failed]
        reference = next(each for each in waiting if each.name == REFERENCE)
        waiting.remove(reference)
        first = self._opened(reference)
        if first is None:
            raise PeersError(f"{self.workload.name}: {REFERENCE} failed: {reference.failed}")
        group, number = [first], 0
        try:
            for contestant in waiting:
                worker = self._opened(contestant)
                if worker is None:
                    continue
                if len(group) > 1 and sum(map(resident_mb, [*group, worker])) > self.memory_mb:
                    self._measure(group, number)
                    for each in group[1:]:
                        each.close()
                    group, number = [first], number + 1
                group.append(worker)
            self._measure(group, number)
        finally:
            for each in group:
                each.close()

    def _opened(self, contestant: Contestant) -> Worker | None:
        """Return the worker, None when it failed; measure its error and peak memory."""
        log = self.workload.folder / "logs" / (contestant.name.replace("/", "-").replace(" ", "-") + ".log")
        worker = Worker(self.workload, contestant, self.core, log)
        try:
            contestant.load_s = worker.ask()["load"]
            with tempfile.TemporaryDirectory(prefix="peers-") as scratch:
                file = Path(scratch) / "outputs.npy"
                peak = float(worker.ask({"outputs": str(file)})["peak"])
                outputs = np.load(file).astype(np.float64)
        except PeersError as error:
            contestant.failed = str(error)
            worker.close()
            self.tell(f"  {contestant.name}: {contestant.failed}")
            return None
        if self._expected is None:
            self._expected = outputs
        if contestant.name in LIMITS:
            contestant.engine, dtype = LIMITS[contestant.name]
            contestant.dtypes = {dtype: 1.0}
            return worker
        contestant.error = mean_error(outputs, self._expected)
        contestant.dtypes = dtypes_of(contestant)
        contestant.engine = engine_of(contestant)
        contestant.peak_mb = peak
        self.tell(f"  {contestant.name}: error {contestant.error:.4f}, {contestant.peak_mb:.0f} MB")
        return worker

    def _measure(self, group: list[Worker], number: int) -> None:
        """Let the group take turns."""
        self.tell(f"  timing {len(group)} contestants, {self.rounds} rounds of {self.block}")
        order = np.random.default_rng(number)
        alive = list(group)
        for each in group[1:]:
            each.contestant.group = number
        for index in range(self.rounds):
            medians = {}
            for place in order.permutation(len(alive)):
                worker = alive[int(place)]
                try:
                    found = worker.ask({"block": self.block, "start": index * self.block})
                except PeersError as error:
                    worker.contestant.failed = str(error)
                    continue
                medians[worker.contestant.name] = {clock: float(np.median(found[clock])) for clock in CLOCKS}
            alive = [worker for worker in alive if not worker.contestant.failed]
            if group[0] not in alive:
                raise PeersError(f"{REFERENCE} ended in the middle: {group[0].contestant.failed}")
            for worker in alive:
                for clock in CLOCKS:
                    worker.contestant.rounds[clock].append(medians[worker.contestant.name][clock])
                    worker.contestant.reference[clock].append(medians[REFERENCE][clock])


def engine_of(contestant: Contestant) -> str:
    """Return what runs a contestant."""
    if not contestant.ours:
        return {"ort": "ort_cpu", "openvino": "openvino", "nncf": "openvino"}.get(contestant.name.partition(":")[0], "")
    manifest = json.loads(Path(contestant.opens.removeprefix(MARK), "manifest.json").read_text(encoding="utf-8"))
    return str(manifest.get("engine") or "ort_cpu")


def dtypes_of(contestant: Contestant) -> dict[str, float]:
    """Return what a contestant computes in: dtype -> share of its multiply-accumulates."""
    if not contestant.ours:
        return {dtype_of(contestant.name): 1.0}
    manifest = json.loads(Path(contestant.opens.removeprefix(MARK), "manifest.json").read_text(encoding="utf-8"))
    shares: dict[str, float] = manifest["graphs"]["main"]["precision"]
    return {dtype: share for dtype, share in shares.items() if share}


def resident_mb(worker: Worker) -> float:
    """Return the resident memory of a worker in MB."""
    lines = Path(f"/proc/{worker.process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) * 1024 / 1e6


def mean_error(outputs: Array, expected: Array) -> float:
    """Return the mean over the samples of the relative L2 error."""
    count = len(expected)
    flat, wanted = outputs.reshape(count, -1), expected.reshape(count, -1)
    return float(np.mean(np.linalg.norm(flat - wanted, axis=1) / np.linalg.norm(wanted, axis=1)))
