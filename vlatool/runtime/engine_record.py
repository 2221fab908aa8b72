"""What an engine ran of a bundle, on what and in which precision, against what the bundle promises.

A session that opens says little: an engine may compute pairs around an int8 layer in float32, have no kernels for
float16, or leave nodes to the processor. The record is of the nodes that ran (``NodeRun``), as the engine itself
reports them, and their multiply-accumulates are counted from the shapes that it reports.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vlatool.bundle.manifest import Graph
from vlatool.errors import GraphError
from vlatool.files.messages import to_json
from vlatool.runtime.engine import FLOAT32, NodeRun, engine_class

ALLOWED_DIFFERENCE = 0.02
"""How much less of the multiply-accumulates than promised may run in a precision: engines compute constants once."""
MAX_NAMES = 3
"""Nodes that a sentence names."""
WEIGHTS_ALONE = " weights"
"""Ending of a precision that says how weights are stored, not what is computed in."""


@dataclass(frozen=True)
class ProviderShare:
    """What one provider ran of a graph.

    Args:
        provider: Execution provider of ONNX Runtime, device of OpenVINO.
        nodes: Number of nodes, without those inside of a node.
        macs: Precision -> share of the graph's multiply-accumulates (0-1), the largest first.
    """

    provider: str
    nodes: int
    macs: Mapping[str, float]


@dataclass(frozen=True)
class GraphRecord:
    """What ran of a graph.

    Args:
        graph: Its name in the bundle.
        promised: Precision -> share of the multiply-accumulates that the manifest promises.
        shares: One for each provider that ran a node; none where the engine does not tell.
        uncounted: Nodes whose multiply-accumulates or precision the engine does not tell.
        problems: Differences from what was asked for, as sentences.
    """

    graph: str
    promised: Mapping[str, float]
    shares: tuple[ProviderShare, ...]
    uncounted: tuple[str, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class EngineRecord:
    """What ran of a bundle.

    Args:
        engine: Name of the engine.
        library: Library and its version.
        device, driver: What it runs on; empty where that is not known.
        power_mode: How the machine is set to spend power; empty where nothing tells.
        graphs: One record for each graph.
    """

    engine: str
    library: str
    device: str
    driver: str
    power_mode: str
    graphs: tuple[GraphRecord, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """All differences from what was asked for."""
        return tuple(problem for graph in self.graphs for problem in graph.problems)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return {**to_json(self), "problems": list(self.problems)}

    def lines(self) -> Iterator[str]:
        """Yield what a person reads: the device, then a line for each provider of each graph, then the problems."""
        where = ", ".join(filter(None, (self.device, self.driver, self.power_mode)))
        yield f"{self.library} on {where or 'an unknown device'}"
        for graph in self.graphs:
            for share in graph.shares:
                yield f"  {graph.graph}  {share.provider}: {share.nodes} nodes, {in_words(share.macs) or 'no products'}"
            if graph.uncounted:
                yield f"  {graph.graph}  not counted: {_listed(graph.uncounted)}"
        yield from (f"  {problem}" for problem in self.problems)

    def check(self) -> None:
        """Refuse an engine that did not run as asked; raises GraphError with the first problem."""
        if self.problems:
            more = len(self.problems) - 1
            raise GraphError(
                f"{self.library} did not run as asked: {self.problems[0]}{f' ({more} more)' if more else ''}",
                "load it with the engine that it was made for, make a bundle for this engine and processor, or accept "
                "that with engine_proof='warn'",
            )


def engine_record(engine: str, graphs: Mapping[str, Graph], sessions: Mapping[str, Any]) -> EngineRecord:
    """Return what ran of a bundle whose sessions are ``traced``, after an inference.

    Args:
        engine: Name of the engine.
        graphs: Those of the manifest, by name.
        sessions: Graph name -> open session.

    Raises:
        MissingExtra: when the engine is not installed.
    """
    from vlatool.machine.host import power_mode

    library = engine_class(engine)
    device, driver = library.hardware()
    records = (graph_record(name, graph, sessions[name], library.targets()) for name, graph in graphs.items())
    title = f"{library.title or engine} {library.version()}".rstrip()
    return EngineRecord(engine, title, device, driver, power_mode(), tuple(records))


def graph_record(name: str, graph: Graph, session: Any, targets: Sequence[str]) -> GraphRecord:
    """Return what a session ran of a graph.

    Args:
        targets: What nodes are to run on; anything when empty.
    """
    promised = promised_shares(graph)
    runs: list[NodeRun] = session.node_runs() if hasattr(session, "node_runs") else []
    uncounted = tuple(dict.fromkeys(_named(run) for run in runs if run.macs is None or not run.precision))
    total = sum(run.macs or 0 for run in runs)
    shares = tuple(
        ProviderShare(provider, len(own), _by_precision(own, total))
        for provider in dict.fromkeys(run.provider for run in runs)
        if (own := [run for run in runs if run.provider == provider])
    )
    problems = [*_elsewhere(runs, total, targets), *_other_precisions(promised, shares, uncounted)]
    if not runs:
        problems = ["the engine tells of no node that it ran."]
    return GraphRecord(name, promised, shares, uncounted, tuple(f"graph '{name}': {problem}" for problem in problems))


def promised_shares(graph: Graph) -> dict[str, float]:
    """Return precision -> share of the multiply-accumulates that a manifest promises of a graph."""
    promised: dict[str, float] = defaultdict(float)
    for precision, share in graph.precision.items():
        promised[graph.compute if graph.compute and precision == FLOAT32 else precision] += share
    return dict(promised)


def in_words(shares: Mapping[str, float]) -> str:
    """Return shares of the multiply-accumulates in words: ``int8 98.0 %, float32 2.0 %``."""
    return ", ".join(f"{precision} {share:.1%}" for precision, share in shares.items())


def _by_precision(runs: Iterable[NodeRun], total: int) -> dict[str, float]:
    counts: Counter[str] = Counter()
    for run in runs:
        counts[run.precision] += run.macs or 0
    return {precision: count / total for precision, count in counts.most_common() if count}


def _elsewhere(runs: Sequence[NodeRun], total: int, targets: Sequence[str]) -> Iterator[str]:
    """Yield what ran on something else than asked for."""
    for provider in dict.fromkeys(run.provider for run in runs if targets and run.provider not in targets):
        own = [run for run in runs if run.provider == provider]
        share = f" ({sum(run.macs or 0 for run in own) / total:.1%} of the multiply-accumulates)" if total else ""
        names = _listed([_named(run) for run in own])
        where = f"{provider or 'something unnamed'}, not on {', '.join(targets)}"
        yield f"{len(own)} of {len(runs)} nodes{share} ran on {where}: {names}."


def _other_precisions(
    promised: Mapping[str, float], shares: Iterable[ProviderShare], uncounted: Sequence[str]
) -> Iterator[str]:
    """Yield the precisions in which less ran than promised."""
    ran: dict[str, float] = defaultdict(float)
    for own in shares:
        for precision, share in own.macs.items():
            ran[precision] += share
    ordered = dict(sorted(ran.items(), key=lambda item: -item[1]))
    for precision, share in promised.items():
        if precision.endswith(WEIGHTS_ALONE) or ran.get(precision, 0.0) >= share - ALLOWED_DIFFERENCE:
            continue
        without = f" (not counted: {_listed(uncounted)})" if uncounted else ""
        found = f"it ran {in_words(ordered)} of them" if ordered else "the engine does not tell what it computed in"
        yield f"{precision} is promised for {share:.1%} of the multiply-accumulates; {found}{without}."


def _named(run: NodeRun) -> str:
    return f"{run.operator} ({run.name})" if run.name else run.operator


def _listed(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES
    return ", ".join([*names[:MAX_NAMES], *([f"{more} more"] if more > 0 else [])])
