"""Which board for a policy: from a source or bundle to a report (``vlatool hwselect``)."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.boards.report import boards_report
from vlatool.boards.select import Choice, Wants, choose, in_the_cloud
from vlatool.boards.simulate import Change, bounds, changes, parts_of, timeline
from vlatool.boards.torch_workload import counted_apart
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, OutputError, SourceError, UsageError
from vlatool.export.onnx import ExportOnnx
from vlatool.files.ownership import add_to_ledger
from vlatool.graph.workload import PRECISIONS, Workload, workload
from vlatool.graph.workload_file import digest, read_workload, refuse_foreign_file, write_workload
from vlatool.hardware.platforms import load_platform
from vlatool.hardware.profile import Profile, load_profile, profile_names
from vlatool.latency_model.board import Candidate, engine_for, outcomes, stored_quantization
from vlatool.latency_model.board_measurements import measured_questions
from vlatool.latency_model.model import LatencyModel, load_model
from vlatool.machine.host import cache_directory
from vlatool.module.description import read_location
from vlatool.module.edits import is_changed
from vlatool.module.origin import origin_of
from vlatool.report import Report
from vlatool.sources import open_source, source_bundle
from vlatool.stage.base import Context
from vlatool.stage.run import cached_transform

WORKLOAD_FILE = "workload.json"
"""File beside ``policy.yaml`` that holds the count of a policy."""


@dataclass(frozen=True)
class Asked(Wants):
    """What a user asks for, and where to look.

    Args:
        platform: Robot platform that gives rate, watts and battery where they are not given.
        boards: Profiles to look at; all when empty.
        cloud: Whether to compare with rented machines.
    """

    platform: str | None = None
    boards: tuple[str, ...] = ()
    cloud: bool = False


def select_boards(source: str, asked: Asked, context: Context, calibration: Path | None = None) -> Report:
    """Return the report of ``vlatool hwselect``.

    Raises:
        UsageError: when a precision is unknown.
        ProfileError: when a board or platform is unknown.
        VlatoolError: when the policy cannot be counted.
    """
    if asked.per_chunk and asked.latency_ms and not asked.hz:
        raise UsageError("--per-chunk asks how often the loop ticks.", "give --hz, too, or leave it out")
    for precision in asked.precisions:
        if precision not in PRECISIONS:
            raise UsageError.unknown(f"--precision is '{precision}'", precision, PRECISIONS)
    if asked.platform:
        sheet = load_platform(asked.platform)
        asked = replace(
            asked,
            hz=asked.hz or (None if asked.latency_ms else sheet.control_hz),
            watts=asked.watts or sheet.compute_watts,
            battery_wh=asked.battery_wh or sheet.battery_wh,
        )
    boards = [load_profile(name) for name in (asked.boards or profile_names())]
    bundle = open_bundle(source, context)
    load = count_workload(bundle, context)
    spec = bundle.manifest.spec
    asked = replace(asked, execute=spec.executed_actions)
    if asked.hz is None and asked.latency_ms is None:
        asked = replace(asked, hz=spec.control_hz)
    model = load_model().condition(measured_questions(calibration))
    owned = [board for board in boards if board.price_usd_per_hour is None]
    rented = [board for board in boards if board.price_usd_per_hour is not None]
    context.progress("predicting", None)
    cloud = _cheapest(rented, load, model, asked) if asked.cloud else None
    choices = choose(owned or rented, load, model, asked)
    return boards_report(source, load, choices, asked, cloud, context.command)


def _cheapest(rented: Sequence[Profile], load: Workload, model: LatencyModel, wants: Wants) -> Choice | None:
    """Return the cheapest rented machine that answers in time, network included."""
    if not rented:
        return None
    fitting = [choice for choice in choose(rented, load, model, in_the_cloud(wants)) if choice.state == "fits"]
    prices = {choice.profile.name: choice.profile.price_usd_per_hour for choice in fitting}
    return min(fitting, key=lambda choice: prices[choice.profile.name].value, default=None)  # type: ignore[union-attr]


def open_bundle(source: str, context: Context) -> Bundle:
    """Return the bundle that is named, or the source bundle of a policy."""
    return source_bundle(open_source(source), cache_directory(), context).bundle


def count_workload(bundle: Bundle, context: Context) -> Workload:
    """Return the work of one inference of a bundle or source.

    It is kept in the cache by the bundle's hash; a policy may carry its count, too (``carry_count``).
    """
    file = cache_directory() / "workloads" / f"{bundle.hash.removeprefix('sha256:')[:32]}.json"
    if (load := read_workload(file)) is not None:
        return load
    if bundle.manifest.graphs:
        load = workload(bundle)
    elif _may_carry(bundle) and (carried := read_workload(_beside(bundle), digest(bundle))) is not None:
        return carried
    elif "factory" in bundle.manifest.source:
        load = _counted_source(bundle, context)
    else:
        load = _counted_export(bundle, context)
    with contextlib.suppress(OSError):  # a cache that cannot be written costs time, nothing else
        write_workload(file, load)
    return load


def _counted_source(bundle: Bundle, context: Context) -> Workload:
    """Count a policy without its weights; where that cannot be, export it and count its graphs.

    A factory that reads its own weights cannot fill modules that have none, and may look at their values.
    """
    context.progress("counting the policy's work, without its weights", None)
    with contextlib.suppress(SourceError):  # what is wrong with the policy itself, the export says
        return counted_apart(bundle, context.progress)
    context.progress("it cannot be counted so; exporting the policy to count its graphs", None)
    return _counted_export(bundle, context)


def _counted_export(bundle: Bundle, context: Context) -> Workload:
    return workload(cached_transform(ExportOnnx(), bundle, cache_directory(), context).bundle)


def carry_count(source: str, context: Context) -> Path:
    """Write the count of a policy beside its ``policy.yaml``: whoever has it then chooses boards without torch.

    The count holds as long as all of ``digest`` is what was counted.

    Raises:
        UsageError: when the source is a bundle or an ONNX file, which are counted without torch, or its factory lies in
            a package, whose changes nobody would notice.
        OutputError: when the file cannot be written, or is none that was counted.
    """
    bundle = open_bundle(source, context)
    if not _may_carry(bundle):
        if bundle.manifest.graphs or "factory" not in bundle.manifest.source:
            raise UsageError(
                f"{source} is counted without torch; only a policy with code carries a count.",
                "leave --carry-count out: it is counted wherever it is used",
            )
        if is_changed(bundle):
            raise UsageError(f"{source} is a bundle; only a policy with code carries a count.", "leave it out")
        raise UsageError(
            f"The factory of {source} lies in a package ({bundle.manifest.source['factory']}), whose changes nobody "
            "would notice.",
            "put the code beside policy.yaml, or leave --carry-count out: the count is in the cache",
        )
    file = origin_of(bundle).folder / WORKLOAD_FILE
    refuse_foreign_file(file)
    load = count_workload(bundle, context)
    try:
        write_workload(file, load, digest(bundle))
        add_to_ledger(file)
    except OSError as error:
        raise OutputError(f"{file} cannot be written: {error.strerror}.", "make the folder writable") from error
    return file


def _may_carry(bundle: Bundle) -> bool:
    """Say whether a count can be known to be of this code: it lies beside ``policy.yaml``, or comes with vlatool."""
    if bundle.manifest.graphs or is_changed(bundle):
        return False
    source = bundle.manifest.source
    return bool(source.get("code")) or str(source.get("factory", "")).startswith("vlatool.")


def _beside(bundle: Bundle) -> Path:
    return read_location(bundle.path) / WORKLOAD_FILE


def simulate(
    source: str, board: str, mode: str | None, engine: str | None, precision: str, context: Context
) -> dict[str, Any]:
    """Return what ``vlatool simulate`` prints, as JSON values.

    Raises:
        ProfileError: when the board, its mode or its engine is unknown.
        UsageError: when the engine does not compute in the precision.
        DataError: when nothing can be predicted; says why.
    """
    profile = load_profile(board)
    name = mode or profile.default_mode
    profile.mode(name)
    asked = Candidate(profile, name, engine or profile.engine, precision)
    if precision and precision not in asked.figures.dtypes:
        raise UsageError.unknown(f"--precision is '{precision}'", precision, asked.figures.dtypes)
    bundle = open_bundle(source, context)
    spec, load = bundle.manifest.spec, count_workload(bundle, context)
    candidate = asked if engine or precision else replace(asked, engine=_engine_of(bundle, profile, load))
    model = load_model().condition(measured_questions())
    outcome = outcomes([candidate], load, model)[0]
    if not outcome.latency.known:
        fix = FIXED_SHAPES if load.unknown else "try another --engine or --precision"
        raise DataError(f"{source} on {board}: {outcome.latency.why}.", fix)
    phases = bounds(outcome, model.shares)
    return {
        "source": source, "profile": board, "mode": name, "engine": candidate.engine,
        "precision": precision or stored_quantization(load) or "float32", "origin": "predicted",
        "latency_ms": [outcome.latency.ms, outcome.latency.low, outcome.latency.high],
        "regime": outcome.latency.regime, "memory_mb": outcome.memory_mb, "watts": outcome.watts,
        "joules": outcome.joules, "execute": spec.executed_actions, "control_hz": spec.control_hz,
        "phases": [
            {"name": bound.phase.name, "runs": bound.phase.runs, "ms": bound.phase.ms, "shares": dict(bound.shares),
             "parts": parts_of(bound.phase, load.graphs[bound.phase.name], model.shares)}
            for bound in phases
        ],
        "timeline": [*timeline(phases)],
        "changes": [_change(change) for change in changes(candidate, load, model)],
    }  # fmt: skip


def _engine_of(bundle: Bundle, profile: Profile, load: Workload) -> str:
    """Return the engine of a board that runs a bundle."""
    if engine := engine_for(profile, load, bundle.manifest.engine):
        return engine
    raise DataError(
        f"No engine of {profile.name} runs {bundle.path}, whose graphs are {stored_quantization(load)}; it has "
        f"{', '.join(profile.engines)}.",
        "quantize for the board: vlatool quantize SOURCE --profile BOARD; or name another --profile",
    )


FIXED_SHAPES = (
    "give every axis a number: write the shapes into the spec of a policy.yaml beside the ONNX file, or export it with "
    "fixed shapes"
)


def _part_lines(phases: list[dict[str, Any]]) -> list[str]:
    lines = []
    for phase in phases:
        shares = sorted(phase["parts"].items(), key=lambda item: -item[1])
        if shares:
            lines.append(f"  {phase['name']}: {', '.join(f'{name} {share:.0%}' for name, share in shares)}")
    return ["parts of a graph, by the work that they have", *lines] if lines else []


def _change(change: Change) -> dict[str, Any]:
    latency = change.outcome.latency
    return {
        "name": change.name, "latency_ms": latency.ms if latency.known else None, "why": latency.why,
        "memory_mb": change.outcome.memory_mb[0], "joules": change.outcome.joules if latency.known else None,
    }  # fmt: skip


def _busy(ms: float, hz: float | None) -> str:
    """Return in words which part of its time a policy computes, of ``ms`` for each action at the rate ``hz``."""
    if hz is None:
        return "the policy's rate is unknown"
    share = ms * hz / 1e3
    words = f"busy {share:.1%} of the time" if share < 1 else f"{share:.3g} times the time that there is"
    return f"at the policy's {hz:g} Hz {words}"


def simulation_lines(simulation: dict[str, Any]) -> list[str]:
    """Return the text of a simulation."""
    ms, low, high = simulation["latency_ms"]
    where = ", ".join(simulation[name] for name in ("profile", "mode", "engine", "precision"))
    costs = f"{simulation['memory_mb'][0]:.0f} MB, {simulation['watts'][0]:.0f} W, {simulation['joules']:.3g} J"
    count, hz = simulation["execute"], simulation["control_hz"]
    actions = f"each of the {count} actions that are executed of it" if count > 1 else "each action"
    busy = _busy(ms / count, hz)
    lines = [
        f"PREDICTED for {where}; nothing was run there",
        f"{ms:.4g} ms an inference (80 %: {low:.4g}-{high:.4g}), {costs}",
        f"{actions}: {ms / count:.3g} ms, {simulation['joules'] / count:.3g} J; {busy}",
        "", *simulation["timeline"], *_part_lines(simulation["phases"]), "", "what a change would give",
    ]  # fmt: skip
    for change in simulation["changes"]:
        if change["latency_ms"] is None:
            lines.append(f"  {change['name']}: unknown ({change['why']})")
            continue
        ratio = ms / change["latency_ms"]
        word = f"{ratio:.2f}x as fast" if ratio >= 1 else f"{1 / ratio:.2f}x slower"
        costs = f"{change['memory_mb']:.0f} MB, {change['joules']:.3g} J"
        lines.append(f"  {change['name']}: {change['latency_ms']:.3g} ms ({word}), {costs}")
    return lines
