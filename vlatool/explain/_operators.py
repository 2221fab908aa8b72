"""Profile of an inference by the engine, operator by operator."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, Observations
from vlatool.files.scratch import scratch_directory
from vlatool.machine.host import onednn_max_cpu_isa
from vlatool.runtime.engine import (
    BFLOAT16,
    DEFAULT_ENGINE,
    FLOAT32,
    INT8,
    MOVING,
    QUANTIZING,
    Engine,
    Node,
    Profiled,
    engine_class,
)
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program

GROUPS = (INT8, BFLOAT16, FLOAT32, MOVING, QUANTIZING)
PRODUCTS = ("MatMul", "Gemm", "Conv", "FullyConnected", "Attention", "ScaledDot")
WARMUP = 3


@dataclass(frozen=True)
class Operator:
    """One node of a graph as the engine runs it.

    Args:
        name: The engine's name of the node, often that of the layer.
        kind: The engine's operator type.
        precision: One of ``GROUPS``, or another dtype.
        kernel: The engine's description of its kernel (OpenVINO), or the dtypes of its inputs (ONNX Runtime).
        calls: Runs in one inference.
        ms: Time of all its runs in one inference, median over the inferences.
    """

    graph: str
    name: str
    kind: str
    precision: str
    kernel: str
    calls: int
    ms: float

    @property
    def node(self) -> Node:
        """Key of the node in the engine's profile."""
        return self.name, self.kind, self.kernel

    @property
    def product(self) -> bool:
        """Whether it is a matrix product or a convolution."""
        return any(word in self.kind for word in PRODUCTS) and self.precision not in (MOVING, QUANTIZING)


def profile(
    bundle: Bundle, observations: Sequence[Mapping[str, Any]], runs: int = 20, threads: int = 1, engine: str = ""
) -> list[Operator]:
    """Run a bundle with the engine's profiler on.

    Args:
        observations: Raw observations, used in turn.
        runs: Number of inferences after three warm-up inferences.
        engine: Engine to profile; the bundle's own when empty.

    Returns:
        Every operator that ran, the slowest first.

    Raises:
        GraphError: when the engine has no profiler on this machine, or fails.
    """
    engine = engine or bundle.manifest.engine or DEFAULT_ENGINE
    library: type[Engine] = engine_class(engine)
    with scratch_directory() as scratch:
        sessions: dict[str, Profiled] = {
            name: library.open_profiled(bundle.file(graph.file), threads, graph.compute, scratch / name)
            for name, graph in bundle.manifest.graphs.items()
        }
        policy = Policy(bundle, Program(bundle.manifest.program, sessions, seed=0), engine)
        for index in range(WARMUP + runs):
            policy.infer(observations[index % len(observations)])
        turns: Counter[str] = Counter()
        for step in bundle.manifest.program:
            turns[step.graph] += step.repeat
        operators = [
            operator
            for name, session in sessions.items()
            for operator in _operators(name, session, turns[name], library)
        ]
    return sorted(operators, key=lambda operator: -operator.ms)


def raw_actions(policy: Policy, observations: Iterable[Mapping[str, Any]]) -> list[Any]:
    """Return the raw action of each observation, each as a separate episode.

    A policy that keeps values also gets the earlier observations of each episode.
    """
    moments: Iterable[Moment]
    if policy.program.keeps and isinstance(observations, Observations):
        moments = observations.with_history()
    else:
        moments = (Moment(observation, number, begins=True) for number, observation in enumerate(observations))
    actions = []
    for moment in moments:
        if moment.begins:
            policy.reset()
        action = np.array(policy.infer(moment.observation).outputs[policy.spec.action.name])
        actions += [action] if moment.counts else []
    return actions


def reference_engine(bundle: Bundle) -> str:
    """Return the engine of float32 in a comparison with a bundle; empty for its own.

    Where OpenVINO is confined to an instruction set, a ratio to ONNX Runtime, which cannot be, would mix two sets.
    """
    engine = bundle.manifest.engine or DEFAULT_ENGINE
    return engine if onednn_max_cpu_isa() and engine_class(engine).confined else ""


def _operators(graph: str, session: Profiled, turns: int, library: type[Engine]) -> Iterable[Operator]:
    """Yield the operators of a graph that runs ``turns`` times in one inference."""
    by_inference: dict[Node, list[float]] = defaultdict(list)
    calls: Counter[Node] = Counter()
    times = session.times()[WARMUP * turns :]
    for start in range(0, len(times), turns or 1):
        total: Counter[Node] = Counter()
        for run in times[start : start + turns]:
            for key, spent in run.items():
                total[key] += spent  # type: ignore[assignment]
                calls[key] += 1
        for key, spent in total.items():
            by_inference[key].append(spent)
    for key, spent_each in by_inference.items():
        name, kind, kernel = key
        count = round(calls[key] / len(spent_each))
        yield Operator(
            graph, name, kind, library.node_precision(key), kernel, count, float(np.median(spent_each)) / 1e3
        )


def shares(operators: Iterable[Operator]) -> dict[str, float]:
    """Return precision -> share of the time (0-1), the groups first and in their order."""
    spent: Counter[str] = Counter()
    listed = list(operators)
    total = sum(operator.ms for operator in listed) or 1.0
    for operator in listed:
        spent[operator.precision] += operator.ms  # type: ignore[assignment]
    order = [*(group for group in GROUPS if group in spent), *(name for name in spent if name not in GROUPS)]
    return {name: spent[name] / total for name in order}


def table(operators: Iterable[Operator], most: int = 14) -> list[dict[str, Any]]:
    """Return rows of operator type, calls, ms, share (per cent) and effective precision; the slowest first."""
    sums: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
    for operator in operators:
        row = sums[operator.kind, operator.precision]
        row[0] += operator.calls
        row[1] += operator.ms
    total = sum(spent for _, spent in sums.values()) or 1.0
    ordered = sorted(sums.items(), key=lambda item: -item[1][1])
    rows = [_table_row(kind, precision, calls, spent, total) for (kind, precision), (calls, spent) in ordered[:most]]
    rest = [numbers for _, numbers in ordered[most:]]
    if rest:
        calls, spent = (sum(numbers[index] for numbers in rest) for index in (0, 1))
        rows.append(_table_row(f"{len(rest)} others", "", calls, spent, total))
    return rows


def _table_row(kind: str, precision: str, calls: float, spent: float, total: float) -> dict[str, Any]:
    numbers = {"calls": int(calls), "ms": round(spent, 4), "share %": round(100 * spent / total, 1)}
    return {"operator": kind, "computed as": precision, **numbers}
