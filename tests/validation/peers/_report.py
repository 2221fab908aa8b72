"""Rows -> the table, the checks, JSON and Markdown."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _interleave import CLOCKS, Contestant
from _limits import LIMITS, share
from _ours import MARK, SEARCH, SEARCH_ORT
from _workload import Array

from vlatool.machine.instruction_sets import SATURATING
from vlatool.measurement.reach import MACS
from vlatool.stats.intervals import quantile_interval

TOLERANCE = 0.02
"""Share of the latency within which two contestants count as equally fast."""
BUDGET = 0.04
ENGINE = "ort_cpu"
TARGET = 3.0
"""Speed-up that is wanted where int8 has instructions of its own: three quarters of what a large product gains."""
TARGET_OF_256_BITS = 2.65
"""The same for VNNI of 256 bits (AVX2_VNNI), where it gains 3.5 times, not 3.9 (docs/measurements/peers.md)."""
TARGETS_OF_ORT = {"vit-s": 2.6, "resnet18": 2.8, "vla-45m": 2.44, "vit-b": 3.11, "action-expert": 3.47}
"""The same where ONNX Runtime alone runs the graph, without matrix units (AMX)."""
SATURATING_TARGETS = {"vit-s": 1.65, "resnet18": 2.2, "vla-45m": 1.55, "vit-b": 1.65, "action-expert": 1.65}
SATURATING_TARGETS_OF_ORT = {**SATURATING_TARGETS, "resnet18": 1.8}
"""Both on sets without VNNI, whose int8 arithmetic is at most 2.06 times as fast as float32."""
REACHED = 0.75
"""Share of a large product's speed that is wanted."""
FOUND = 0.98
"""Least speed of what the search delivers, beside the fastest bundle of one command within the budget."""


@dataclass(frozen=True)
class Check:
    """One line of the verdict."""

    passed: bool
    text: str

    def __str__(self) -> str:
        return f"{'PASS' if self.passed else 'FAIL'} {self.text}"


class Table:
    """The rows of one workload, compared by one clock.

    Args:
        workload: Its name.
        rows: All contestants, failed ones too.
        clock: ``cpu`` or ``wall``.
        macs: Multiply-accumulates of one inference; 0 when not known.
        instruction_set: The processor's, as ``rung`` names it.
    """

    def __init__(
        self, workload: str, rows: Sequence[Contestant], clock: str, macs: float = 0.0, instruction_set: str = ""
    ) -> None:
        self.workload, self.clock, self.macs, self.set = workload, clock, macs, instruction_set
        self.failed = [row for row in rows if row.failed]
        self.limits = [row for row in rows if row.name in LIMITS and not row.failed]
        measured = [row for row in rows if not row.failed and row.name not in LIMITS]
        self.rows = sorted(measured, key=lambda row: -self.speedup(row)[0])

    def p50(self, row: Contestant, clock: str = "") -> float:
        """Return the median milliseconds."""
        return float(np.median(row.rounds[clock or self.clock]))

    def speedup(self, row: Contestant, clock: str = "") -> tuple[float, float | None, float | None]:
        """Return the reference's median over the row's, within a round: median over the rounds and its interval."""
        clock = clock or self.clock
        ratios = np.asarray(row.reference[clock]) / np.asarray(row.rounds[clock])
        _, low, high = quantile_interval(ratios, 0.5)
        return float(np.median(ratios)), low, high

    def relative(self, row: Contestant, other: Contestant) -> float:
        """Return the latency of a row over that of another, within rounds where both took turns."""
        ratios = self._ratios(row, other)
        return self.speedup(other)[0] / self.speedup(row)[0] if ratios is None else float(np.median(ratios))

    def _ratios(self, row: Contestant, other: Contestant) -> Array | None:
        if row.group != other.group:
            return None
        return np.asarray(row.rounds[self.clock]) / np.asarray(other.rounds[self.clock])

    def share(self, row: Contestant, other: Contestant) -> str:
        """Return ``relative`` with its interval where there is one."""
        ratios = self._ratios(row, other)
        _, low, high = (0.0, None, None) if ratios is None else quantile_interval(ratios, 0.5)
        bounds = f" ({low:.3f}-{high:.3f})" if low is not None and high is not None else ""
        return f"{self.relative(row, other):.3f}{bounds}"

    def dominates(self, row: Contestant, other: Contestant) -> bool:
        """Say whether a row is faster, by more than the tolerance and beyond chance, and at most as wrong."""
        faster = self.relative(row, other) < 1 - TOLERANCE and self._beyond_chance(row, other)
        return row.error <= other.error and faster

    def _beyond_chance(self, row: Contestant, other: Contestant) -> bool:
        """Say whether the ratio's interval leaves equality out; without turns together, whether theirs are apart."""
        ratios = self._ratios(row, other)
        if ratios is None:
            _, low, _ = self.speedup(row)
            _, _, high = self.speedup(other)
            return low is not None and high is not None and low > high
        _, _, high = quantile_interval(ratios, 0.5)
        return high is not None and high < 1

    def dominated_by(self, row: Contestant) -> Contestant | None:
        """Return the fastest of the other side that dominates the row."""
        return next((other for other in self.rows if other.ours != row.ours and self.dominates(other, row)), None)

    def frontier(self) -> list[Contestant]:
        """Return our rows that none of ours makes needless: less wrong and, within the tolerance, as fast."""
        ours = [row for row in self.rows if row.ours]

        def needless(row: Contestant) -> bool:
            return any(
                (other.error, self.p50(other), other.name) < (row.error, self.p50(row), row.name)
                and self.relative(other, row) <= 1 + TOLERANCE
                for other in ours
            )

        return [row for row in ours if not needless(row)]

    def uncovered(self) -> list[Contestant]:
        """Return the peers' rows that none of ours equals in both latency (within the tolerance) and error."""
        ours = [row for row in self.rows if row.ours]

        def covered(peer: Contestant) -> bool:
            return any(own.error <= peer.error and self.relative(own, peer) <= 1 + TOLERANCE for own in ours)

        return [row for row in self.rows if not row.ours and not covered(row)]

    def gmacs(self, row: Contestant) -> float:
        """Return how many 10^9 multiply-accumulates a row does in a second."""
        return self.macs / self.p50(row) / 1e6

    def reached(self, row: Contestant) -> float | None:
        """Return the share of the speed of large products in the same engine; None where there is no such figure."""
        reach = {
            dtype: self.p50(limit) for limit in self.limits if limit.engine == row.engine for dtype in limit.dtypes
        }
        return share(self.macs, row.dtypes, reach, self.p50(row))

    @property
    def saturates(self) -> bool:
        """Whether the processor has no VNNI."""
        return self.set in SATURATING

    def told(self, row: Contestant) -> str:
        """Return a row in short."""
        return f"'{row.name}' ({interval(self.speedup(row))}, error {row.error:.4f})"

    def checks(self) -> list[Check]:
        """Return the verdict."""
        ours = [row for row in self.rows if row.ours]
        peers = [row for row in self.rows if not row.ours]
        if not ours or not peers:
            return [Check(False, "nothing to compare: there are no figures of both sides")]
        found = [self._check_domination(), self._check_budget(ours), self._check_fastest(ours[0], peers[0])]
        return [*found, *self._check_onnxruntime(), *self._check_search(ours), *self._check_reached(ours)]

    def _check_search(self, ours: Sequence[Contestant]) -> list[Check]:
        """Compare what the search delivers with every bundle of one command within the budget."""
        checks = []
        for search, among in ((SEARCH, ours), (SEARCH_ORT, [row for row in ours if row.engine == ENGINE])):
            found = next((row for row in among if row.name == f"{MARK}{search}"), None)
            single = [row for row in among if row.error <= BUDGET and SEARCH.split(",")[0] not in row.name]
            if found is None or not single:
                continue
            ratio = self.relative(single[0], found)
            text = f"(e) the search delivers {self.told(found)}; the fastest of one command is {self.told(single[0])}"
            passed = found.error <= BUDGET and ratio >= FOUND
            checks.append(Check(passed, f"{text}, {self.share(single[0], found)} of its time"))
        return checks

    def _check_reached(self, ours: Sequence[Contestant]) -> list[Check]:
        """Say which share of the reachable float32 and the fastest int8 bundles reach."""
        within = [row for row in ours if row.error <= BUDGET and "int8" in row.dtypes]
        first = {
            "float32": [row for row in ours if row.name == f"{MARK}float32"],
            "int8": within,
            "int8 in ONNX Runtime": [row for row in within if row.engine == ENGINE],
        }
        reached = {name: self.reached(rows[0]) for name, rows in first.items() if rows}
        told = [(name, part) for name, part in reached.items() if part is not None]
        if not told:
            return []
        text = ", ".join(f"{name} {part:.0%}" for name, part in told)
        return [Check(all(part >= REACHED for _, part in told), f"(f) of the reachable: {text}; wanted {REACHED:.0%}")]

    def _check_domination(self) -> Check:
        frontier = self.frontier()
        beaten = [(row, by) for row in frontier if (by := self.dominated_by(row)) is not None]
        names = ", ".join(f"'{row.name}'" for row in frontier)
        if not beaten:
            return Check(True, f"(a) no peer dominates a point of our frontier: {names}")
        lines = [
            f"{self.told(row)} is dominated by {self.told(by)}, which takes {self.share(by, row)} of its time"
            for row, by in beaten
        ]
        return Check(False, "(a) " + "; ".join(lines))

    def _check_budget(self, ours: Sequence[Contestant]) -> Check:
        inside = [row for row in ours if row.error <= BUDGET]
        if not inside:
            return Check(False, f"(b) none of ours has an error of at most {BUDGET}")
        target = self._target()
        reached = self.speedup(inside[0])[0] >= target
        return Check(reached, f"(b) our fastest at error <= {BUDGET}: {self.told(inside[0])}; wanted {target:g}x")

    def _target(self) -> float:
        """Return the speed-up that is wanted on this instruction set."""
        if self.saturates:
            return SATURATING_TARGETS.get(self.workload, 0.0)
        return TARGET_OF_256_BITS if self.set == "AVX2_VNNI" else TARGET

    def _check_fastest(self, own: Contestant, peer: Contestant) -> Check:
        text = f"(c) our fastest {self.told(own)} takes {self.share(own, peer)} of the time of the fastest peer "
        return Check(self.relative(own, peer) <= 1 + TOLERANCE, text + self.told(peer))

    def _check_onnxruntime(self) -> list[Check]:
        """Compare what ONNX Runtime alone runs, as on boards with ARM; nothing where that was not measured."""
        rows = [row for row in self.rows if row.engine == ENGINE]
        alone = Table(self.workload, rows, self.clock, self.macs, self.set)
        ours = [row for row in alone.rows if row.ours]
        if not ours or len(ours) == len(alone.rows):
            return []
        beaten = [(row, by) for row in ours if (by := alone.dominated_by(row)) is not None]
        told = "; ".join(f"{self.told(row)} is dominated by {self.told(by)}" for row, by in beaten)
        inside = [row for row in ours if row.error <= BUDGET]
        targets = SATURATING_TARGETS_OF_ORT if self.saturates else TARGETS_OF_ORT
        wanted = targets.get(self.workload, 0.0)
        reached = bool(inside) and self.speedup(inside[0])[0] >= wanted
        best = f"our fastest at error <= {BUDGET}: {self.told(inside[0])}" if inside else f"none at error <= {BUDGET}"
        text = f"(d) in ONNX Runtime alone {told or 'no peer dominates any of ours'}; {best}; wanted {wanted:g}x"
        return [Check(not beaten and reached, text)]

    def lines(self) -> list[str]:
        """Return the table in Markdown."""
        head = (
            *("config", "CPU p50 ms", "wall p50 ms", "speed-up (CPU)", "speed-up (wall)", "error", "peak MB"),
            *("GMAC/s", "of the reachable"),
        )
        found = ["| " + " | ".join((*head, "dominated by")) + " |", "|" + "---|" * (len(head) + 1)]
        for row in self.rows:
            by, part = self.dominated_by(row), self.reached(row)
            cells = [
                f"**{row.name}**" if row.ours else row.name,
                *(f"{self.p50(row, clock):.2f}" for clock in CLOCKS),
                *(interval(self.speedup(row, clock)) for clock in CLOCKS),
                f"{row.error:.4f}",
                f"{row.peak_mb:.0f}",
                f"{self.gmacs(row):.0f}",
                "-" if part is None else f"{part:.0%}",
                by.name if by else "",
            ]
            found.append("| " + " | ".join(cells) + " |")
        empty = " | " * 8
        found += [f"| {row.name} | failed: {row.failed.replace('|', '/')}{empty}|" for row in self.failed]
        for row in self.limits:
            found.append(f"| {row.name} | {self.p50(row):.2f} | {self.p50(row, 'wall'):.2f} | | | | | "
                         f"{MACS / self.p50(row) / 1e6:.0f} | 100% | |")  # fmt: skip
        return found


def interval(value: tuple[float, float | None, float | None]) -> str:
    """Return a ratio with its interval."""
    middle, low, high = value
    return f"{middle:.2f}x" + (f" ({low:.2f}-{high:.2f})" if low is not None and high is not None else "")


def markdown(table: Table) -> str:
    """Return the section of one workload."""
    lines = [f"### {table.workload}", "", *table.lines(), ""]
    lines += [f"- {check}" for check in table.checks()]
    if uncovered := table.uncovered():
        told = ", ".join(table.told(row) for row in uncovered)
        lines.append(f"- peers that none of ours equals in both latency and error: {told}")
    return "\n".join(lines) + "\n"


def save(path: Path, rows: Sequence[Contestant], about: dict[str, Any]) -> None:
    """Write everything that was measured."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {**about, "rows": [asdict(row) for row in rows]}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read(path: Path) -> tuple[list[Contestant], dict[str, Any]]:
    """Return what ``save`` wrote."""
    content = json.loads(path.read_text(encoding="utf-8"))
    rows = [Contestant(**row) for row in content.pop("rows")]
    return rows, content
