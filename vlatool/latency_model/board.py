"""A policy on a board: compute unit, latency, memory, power and energy."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from vlatool.errors import ProfileError
from vlatool.graph.workload import PRECISIONS, GraphWorkload, Workload, stored_precision
from vlatool.hardware.profile import EngineFigures, Profile
from vlatool.latency_model.features import ComputeUnit, Question, Shares, Work, roofline_parts
from vlatool.latency_model.model import LatencyModel, Prediction
from vlatool.latency_model.published_latencies import published_devices

FLOAT32 = 4
BUSY, BUSY_LOW, BUSY_HIGH = 0.65, 0.45, 0.95
"""Share of a mode's power limit that a board draws at the wall while it infers. Of 414 published runs on Jetson AGX
Orin 32 GB and AGX Xavier (MLPerf, wall power) the medians by runtime lie at 0.46-0.82."""
IDLE = 0.3
"""Share of the limit drawn when nothing runs, where the profile lacks it."""
PACKED_RATIO, PACKED_RATIO_HIGH = 1.3, 2.0
"""Memory of a process for weights, relative to their size: engines keep packed copies of some. Measured with ONNX
Runtime and OpenVINO on an x86 host: 1.0 to 1.9."""
ARENA, ARENA_HIGH = 3.0, 5.0
"""Memory that an engine reserves, relative to the live tensors."""
EXTRA_MB, EXTRA_HIGH_MB = 15.0, 40.0


@dataclass(frozen=True)
class Candidate:
    """A board with power mode and engine, and the precision of the policy.

    Args:
        precision: Precision of weights and activations (a key of ``PRECISIONS``); that of the bundle when empty.
    """

    profile: Profile
    mode: str
    engine: str
    precision: str = ""

    @property
    def figures(self) -> EngineFigures:
        """Figures of the engine in the profile; raises ProfileError when it has no such engine."""
        engines = self.profile.engines
        if self.engine not in engines:
            raise ProfileError.unknown(f"{self.profile.name} has no engine '{self.engine}'", self.engine, engines)
        return engines[self.engine]


@dataclass(frozen=True)
class Phase:
    """One graph of an inference on a candidate.

    Args:
        runs: Number of runs in one inference.
        once: Prediction of one run.
    """

    name: str
    runs: int
    once: Prediction
    question: Question

    @property
    def ms(self) -> float:
        """Milliseconds of all runs."""
        return self.runs * self.once.ms


@dataclass(frozen=True)
class Outcome:
    """Predicted outcome of one inference on a candidate.

    Args:
        latency: Milliseconds of the whole inference.
        memory_mb: Memory of the process, with bounds (10^6 bytes).
        watts: Power at the wall during inference, with bounds.
    """

    candidate: Candidate
    phases: tuple[Phase, ...]
    latency: Prediction
    memory_mb: tuple[float, float, float]
    watts: tuple[float, float, float]

    @property
    def joules(self) -> float:
        """Energy of one inference; NaN when the latency is unknown."""
        return self.watts[0] * self.latency.ms / 1e3

    def average_watts(self, hz: float) -> float:
        """Return the average power at that rate of inferences, idle in between."""
        busy = min(1.0, hz * self.latency.ms / 1e3)
        idle = idle_watts(self.candidate)
        return idle + (self.watts[0] - idle) * busy


def candidates(profile: Profile, load: Workload, modes: Iterable[str] | None = None) -> list[Candidate]:
    """Return every way of running a policy on a board, the preferred engine and its fastest precision first.

    A bundle that is quantized already keeps its precision, on the engines that compute in it.
    """
    stored = stored_quantization(load)
    integer = any(graph.integer_ops for graph in load.graphs.values())

    def precisions(figures: EngineFigures) -> tuple[str, ...]:
        if not stored:
            return figures.dtypes
        return ("",) if stored in figures.dtypes and (figures.integer_ops or not integer) else ()

    return [
        Candidate(profile, mode, engine, precision)
        for mode in (profile.modes if modes is None else modes)
        for engine, figures in profile.engines.items()
        for precision in precisions(figures)
    ]


def engine_for(profile: Profile, load: Workload, own: str = "") -> str:
    """Return the engine of a board that a policy runs in: its own, the preferred one, or the first that can run it.

    Args:
        own: Engine that the bundle was made for, if any.

    Returns:
        Name of the engine; empty where no engine of the board runs these graphs.
    """
    supported = dict.fromkeys(way.engine for way in candidates(profile, load, [profile.default_mode]))
    return next((name for name in (own, profile.engine, *supported) if name in supported), "")


def compute_unit_of(candidate: Candidate) -> ComputeUnit:
    """Return the compute unit at the clocks of the power mode."""
    profile, figures = candidate.profile, candidate.figures
    caps, part = profile.mode(candidate.mode), profile.units[figures.unit]
    unit = "igpu" if figures.runtime == "openvino-igpu" else figures.unit
    peaks = {dtype: profile.peak_tops(figures.unit, dtype, candidate.mode) or math.nan for dtype in part.peak_tops}
    own = part.bandwidth_gb_s.value if part.bandwidth_gb_s else math.inf
    return ComputeUnit(
        published_devices().get((profile.name, unit), profile.name), unit,
        caps.cores.get(figures.unit, part.cores.value), caps.clock_mhz.get(figures.unit, part.clock_mhz.value) / 1e3,
        peaks, min(own, caps.bandwidth_gb_s), candidate.mode, " ".join(part.isa),
    )  # fmt: skip


def outcomes(requested: Sequence[Candidate], load: Workload, model: LatencyModel) -> list[Outcome]:
    """Predict every candidate, with all questions to the model at once."""
    questions: list[Question] = []
    spans: list[list[tuple[str, int]]] = []
    for candidate in requested:
        compute_unit = compute_unit_of(candidate)
        spans.append([(name, runs) for name, runs in load.runs.items() if load.graphs[name].layers])
        for name, _ in spans[-1]:
            graph = load.graphs[name]
            precision = candidate.precision or stored_precision(graph)
            questions.append(Question(work_of(graph), compute_unit, candidate.figures.runtime, precision))
    predictions = [_apply_roofline(*pair) for pair in zip(questions, model.predict(questions), strict=True)]
    remaining = iter(zip(questions, predictions, strict=True))
    results = []
    for candidate, span in zip(requested, spans, strict=True):
        phases = tuple(
            Phase(name, runs, answer, question)
            for (name, runs), (question, answer) in zip(span, remaining, strict=False)
        )
        latency = _total_latency(candidate, load, phases)
        results.append(Outcome(candidate, phases, latency, memory_mb(candidate, load), watts(candidate)))
    return results


def work_of(graph: GraphWorkload) -> Work:
    """Return the work of one run of a graph for the latency model."""
    return Work(sum(graph.macs.values()), graph.reads, graph.activations, graph.layers, graph.traits)


def stored_quantization(load: Workload) -> str:
    """Return the precision of a quantized bundle; empty for a float32 one."""
    if all(set(graph.macs) <= {"float32"} for graph in load.graphs.values()):
        return ""
    name = max(load.graphs, key=lambda graph: sum(load.graphs[graph].macs.values()) * load.runs.get(graph, 0))
    return stored_precision(load.graphs[name])


def _apply_roofline(question: Question, answer: Prediction) -> Prediction:
    """Raise a prediction to the roofline: no board is faster than its operations and its memory."""
    if not answer.known:
        return answer
    parts = roofline_parts(question, Shares(1.0, 1.0, 1.0, 0.0))
    least = max(parts["compute"], parts["memory"])
    return replace(answer, ms=max(answer.ms, least), low=max(answer.low, least), high=max(answer.high, least))


def _total_latency(candidate: Candidate, load: Workload, phases: Sequence[Phase]) -> Prediction:
    """Add up the phases; their errors share a board and a runtime, so the bounds add up, too."""
    if load.unknown:
        count = len(load.unknown)
        return Prediction(math.nan, why=f"{count} layers have no static shape, for example {load.unknown[0]}")
    if not phases:
        return Prediction(math.nan, why="the graphs have no matrix product or convolution to count")
    if not candidate.figures.runtime:
        return Prediction(math.nan, why=f"no latency was published for {candidate.engine}")
    unknown = next((phase.once for phase in phases if not phase.once.known), None)
    if unknown is not None:
        return unknown
    ms, low, high = (sum(phase.runs * getattr(phase.once, name) for phase in phases) for name in ("ms", "low", "high"))
    regimes = {phase.once.regime for phase in phases}
    return Prediction(ms, low, high, "unseen" if "unseen" in regimes else min(regimes))


def memory_mb(candidate: Candidate, load: Workload) -> tuple[float, float, float]:
    """Return the memory of the process in MB (10^6 bytes) and its bounds, which are a judgement."""
    base = candidate.figures.base_mb.value
    weights = weight_bytes(load, candidate.precision) / 1e6
    width = PRECISIONS[candidate.precision][1] / FLOAT32 if candidate.precision else 1.0
    live = load.peak_bytes * width / 1e6
    return (
        base + PACKED_RATIO * weights + ARENA * live + EXTRA_MB, base + weights + live,
        base + PACKED_RATIO_HIGH * weights + ARENA_HIGH * live + EXTRA_HIGH_MB,
    )  # fmt: skip


def weight_bytes(load: Workload, precision: str) -> float:
    """Return the bytes of all weights at a precision; lookup tables have at least 16 bits."""
    if not precision:
        return float(load.weight_bytes)
    width, table_width = PRECISIONS[precision][0], max(2.0, PRECISIONS[precision][0])
    products = sum(graph.weights for graph in load.graphs.values())
    elements = sum(_elements(graph) for graph in load.graphs.values())
    return products * width + max(0.0, elements - products) * table_width


def _elements(graph: GraphWorkload) -> float:
    """Return the elements of all weights of a float32 graph; of another one, those of its products."""
    whole = set(graph.macs) <= {"float32"}
    return graph.weight_bytes / FLOAT32 if whole else graph.weights


def watts(candidate: Candidate) -> tuple[float, float, float]:
    """Return the power during inference with bounds, as shares of the limit of the mode."""
    limit = power_limit(candidate)
    return BUSY * limit, BUSY_LOW * limit, BUSY_HIGH * limit


def power_limit(candidate: Candidate) -> float:
    """Return the largest power of the board in the mode."""
    return candidate.profile.mode(candidate.mode).power_w or candidate.profile.power_w.value


def idle_watts(candidate: Candidate) -> float:
    """Return the idle power of the board."""
    idle = candidate.profile.idle_w
    limit = power_limit(candidate)
    return min(idle.value if idle else IDLE * limit, BUSY_LOW * limit)


def rescale(
    load: Workload, scale: dict[str, tuple[float, float, float]], runs: dict[str, int] | None = None
) -> Workload:
    """Return a workload with scaled graphs: name -> factors of multiply-accumulates, weights and activations."""
    graphs = {}
    for name, graph in load.graphs.items():
        macs, weights, activations = scale.get(name, (1.0, 1.0, 1.0))
        graphs[name] = replace(
            graph,
            macs={kind: int(count * macs) for kind, count in graph.macs.items()},
            weights=int(graph.weights * weights),
            read_again=int(graph.read_again * weights),
            weight_bytes=int(graph.weight_bytes * weights),
            activations=int(graph.activations * activations),
            activation_bytes=int(graph.activation_bytes * activations),
            peak_bytes=int(graph.peak_bytes * activations),
        )
    return Workload(graphs, {**load.runs, **(runs or {})})
