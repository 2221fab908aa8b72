"""Predict latency and memory of a workload on a profile's board, or say why there is no ground for a prediction.

Latency is a roofline with a cost for each layer (Williams, Waterman, Patterson, CACM 2009, and the per-layer term):

    time of a graph = max(compute, memory) + layers x overhead
    compute = sum over precisions of 2 MACs / (peak x share)
    memory  = (bytes of weights + bytes that compute layers write) / (bandwidth x share)

The shares and the overhead are figures of the profile, by engine and dtype. On 4,498 published latencies (38 devices,
half fitted, half predicted) this model had a relative error of 20 % in the median and 80 % at the 90th percentile, and
of 41 % and 89 % on a device that was left out. The second holds wherever a figure is an estimate or unverified.
"""

from __future__ import annotations

import math

from vlatool.errors import ProfileError, nearest
from vlatool.hwselect._workload import GraphWorkload, Workload
from vlatool.profile import GROUNDED, EngineFigures, Profile
from vlatool.report import Measurement

ERROR_KNOWN, ERROR_UNSEEN = 0.80, 0.89
"""90th percentile of |predicted - measured| / measured, on known devices and on a device that was left out."""
COVERAGE = 0.9
MEMORY_LOW, MEMORY_HIGH = 0.8, 2.0
"""Bounds of memory: engines hold part of the weights twice (packed for the processor) or drop the file's copy."""


def predict(profile: Profile, workload: Workload, engine: str | None = None, mode: str | None = None) -> Measurement:
    """Return the predicted median latency in ms of one inference; NaN with a note where there is no ground.

    ``engine`` defaults to the profile's preferred one, ``mode`` to the power mode in which the board starts.

    Raises:
        ProfileError: when the profile has no such engine or mode.
    """
    name = engine or profile.engine
    figures = _figures(profile, name)
    if reason := _no_ground(profile, figures, workload, mode):
        return _unknown("latency_p50", "ms", profile, f"{name}: {reason}")
    seconds = math.fsum(
        _graph_seconds(profile, figures, graph, mode) * workload.runs.get(key, 0)
        for key, graph in workload.graphs.items()
    )
    error, basis = ERROR_KNOWN, "on devices of the fit"
    if not _is_grounded(profile, figures, workload):
        error, basis = ERROR_UNSEEN, "on a device outside the fit, as some figures here are estimates"
    note = (
        f"{name}, power mode {mode or profile.default_mode}; roofline with per-layer overhead, whose relative error is "
        f"{error:.0%} at the 90th percentile {basis}; excludes pre- and postprocessing"
    )
    value = seconds * 1e3
    low, high = value / (1 + error), value / (1 - error)
    return Measurement("latency_p50", value, "ms", "predicted", profile.name, 0, low, high, COVERAGE, note)


def predict_memory(profile: Profile, workload: Workload, engine: str | None = None) -> Measurement:
    """Return the predicted memory of the process in MB (10^6 bytes): engine, weights and live tensors.

    Raises:
        ProfileError: when the profile has no such engine.
    """
    name = engine or profile.engine
    base = _figures(profile, name).base_mb
    if workload.unknown:
        return _unknown("memory", "MB", profile, _unknown_layers(workload))
    value = base.value + (workload.weight_bytes + workload.peak_bytes) / 1e6
    low, high = value * MEMORY_LOW, value * MEMORY_HIGH
    usable = profile.usable_memory_gb.value * 1e3
    fits = "fits into" if high <= usable else "does not fit into" if low > usable else "may not fit into"
    note = (
        f"{name}: {base.value:g} MB for the engine ({base.kind}), weights and live tensors; "
        f"{fits} the {usable:g} MB that are usable; bounds are a judgement, not a confidence interval"
    )
    return Measurement("memory", value, "MB", "predicted", profile.name, 0, low, high, COVERAGE, note)


def _figures(profile: Profile, engine: str) -> EngineFigures:
    if engine not in profile.engines:
        raise ProfileError(f"{profile.name} has no engine '{engine}'; {nearest(engine, profile.engines)}.")
    return profile.engines[engine]


def _graph_seconds(profile: Profile, figures: EngineFigures, graph: GraphWorkload, mode: str | None) -> float:
    if not any(graph.macs.values()):
        return 0.0
    compute = 0.0
    for dtype, count in graph.macs.items():
        share = figures.efficiency[dtype]
        peak = profile.peak_tops(figures.unit, share.peak or dtype, mode) or math.nan
        compute += 2 * count / (peak * 1e12 * share.compute)
    main = max(graph.macs, key=lambda dtype: graph.macs[dtype])
    share = figures.efficiency[main]
    moved = graph.weight_bytes + graph.activation_bytes
    memory = moved / (profile.mode(mode).bandwidth_gb_s * 1e9 * share.bandwidth)
    return max(compute, memory) + graph.layers * share.layer_us * 1e-6


def _no_ground(profile: Profile, figures: EngineFigures, workload: Workload, mode: str | None) -> str:
    """Return why nothing can be predicted, or an empty string."""
    profile.mode(mode)
    if workload.unknown:
        return _unknown_layers(workload)
    macs = {dtype for dtype, count in workload.macs.items() if count}
    if not macs:
        return "the graphs have no matrix product or convolution to count"
    if absent := sorted(macs - {*figures.efficiency}):
        return f"no published latencies in {', '.join(absent)} to predict from"
    if not figures.integer_ops and any(graph.integer_ops for graph in workload.graphs.values()):
        return "the published int8 latencies are of QDQ graphs, and this policy uses integer operators"
    return ""


def _is_grounded(profile: Profile, figures: EngineFigures, workload: Workload) -> bool:
    """Whether every figure that the prediction uses rests on something that was seen."""
    used = {dtype: figures.efficiency[dtype] for dtype, count in workload.macs.items() if count}
    peaks = profile.units[figures.unit].peak_tops
    kinds = [share.kind for share in used.values()] + [peaks[share.peak or dtype].kind for dtype, share in used.items()]
    return all(kind in GROUNDED for kind in (*kinds, profile.bandwidth_gb_s.kind))


def _unknown_layers(workload: Workload) -> str:
    return f"{len(workload.unknown)} layers have no static shape, for example {workload.unknown[0]}"


def _unknown(name: str, unit: str, profile: Profile, note: str) -> Measurement:
    return Measurement(name, math.nan, unit, "predicted", profile.name, note=note)
