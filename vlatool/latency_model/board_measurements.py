"""A user's measurements on a board for the latency model: ``vlatool profiles calibrate``."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.errors import DataError, ProfileError
from vlatool.files.messages import to_json
from vlatool.files.user_files import atomic_file
from vlatool.graph.workload import PRECISIONS, TRAITS, WORKLOAD_TABLE, Workload, summarize_workload
from vlatool.hardware.profile import Profile, load_profile, profile_names
from vlatool.latency_model.board import Candidate, compute_unit_of
from vlatool.latency_model.features import Question, Work
from vlatool.machine.host import matches
from vlatool.measures.latency import LATENCY_P50
from vlatool.report import read_report

CALIBRATIONS_VARIABLE = "VLATOOL_CALIBRATIONS"
NUMBERS = ("macs", "weights", "activations", "layers")
SCHEMA_VERSION = 1
REDO_FIX = "remove it, and make it again: vlatool profiles calibrate PROFILE --from REPORT"


@dataclass(frozen=True)
class BoardMeasurement:
    """One latency on a board.

    Args:
        profile, mode, engine, precision: Names as in a profile.
        ms: Median latency.
    """

    profile: str
    mode: str
    engine: str
    precision: str
    work: Mapping[str, Any]
    ms: float

    def question(self) -> Question:
        """Return the corresponding question; raises ProfileError when the profile, its mode or its engine is gone."""
        candidate = Candidate(load_profile(self.profile), self.mode, self.engine, self.precision)
        macs, weights, activations, layers = (float(self.work[name]) for name in NUMBERS)
        work = Work(macs, weights, activations, layers, frozenset(self.work.get("traits", ())))
        return Question(work, compute_unit_of(candidate), candidate.figures.runtime, self.precision)


def report_measurements(
    report: Path, profile: Profile, mode: str | None, load: Workload | None = None
) -> list[BoardMeasurement]:
    """Return the latencies of a benchmark report from a board.

    Args:
        report: ``report.json`` or its directory.
        mode: Power mode of the board; the default one when None.
        load: Workload of the policy, for a report without it.

    Raises:
        DataError: when there is no such report, or it has no latency with its workload.
        ProfileError: when the profile has no such mode.
    """
    measured = []
    missing = 0
    name = mode or profile.default_mode
    profile.mode(name)
    benchmark = read_report(report)
    run = benchmark.environment.get("run")
    if isinstance(run, dict) and (run.get("rate_hz") or run.get("emulates")):
        how = "was paced (--rate)" if run.get("rate_hz") else f"emulates {run['emulates']} on another machine"
        raise DataError(f"{report} cannot calibrate {profile.name}: it {how}.", "measure back to back, on the board")
    for row in benchmark.rows:
        latency = row.get(LATENCY_P50)
        if latency is None or not latency.known:
            continue
        tables = row.details.get(WORKLOAD_TABLE) or [summarize_workload(load) if load else {}]
        described = tables[0]
        if not described:
            missing += 1
            continue
        engine = str(described.get("engine") or profile.engine)
        work = {key: described.get(key) for key in (*NUMBERS, "traits")}
        item = BoardMeasurement(profile.name, name, engine, str(described.get("precision")), work, latency.value)
        if engine in profile.engines and is_valid(item):
            measured.append(item)
    if not measured:
        why = "its rows have no workload" if missing else "it has no latency of an engine of this board"
        raise DataError(
            f"{report} cannot calibrate {profile.name}: {why}.",
            "name the bundle that was measured with --bundle, or measure it again: vlatool benchmark BUNDLE -o DIR",
        )
    return measured


def foreign_host(report: Path, profile: Profile) -> str:
    """Return the host of a report when that is not the profile's board; empty when it is, or is unknown."""
    made_on = read_report(report).environment
    names = [str(made_on[key]) for key in ("board", "cpu") if made_on.get(key)]
    return "" if matches(profile.model_strings, made_on) else ", ".join(names)


def store(measured: list[BoardMeasurement]) -> Path:
    """Store measurements together with earlier ones; return the file."""
    file = calibrations() / f"{measured[0].profile}.json"
    known = [item for item in _read(file) if item not in measured] if file.is_file() else []
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = to_json([*known, *measured])
    with atomic_file(file) as draft:
        draft.write_text(json.dumps({"schema": SCHEMA_VERSION, "measured": rows}, indent=1) + "\n", encoding="utf-8")
    return file


def calibrations() -> Path:
    """Return the directory of measurements: ``$VLATOOL_CALIBRATIONS``, or in the user's data directory."""
    named = os.environ.get(CALIBRATIONS_VARIABLE)
    data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return Path(named) if named else data / "vlatool" / "calibrations"


def measured_questions(file: Path | None = None) -> list[tuple[Question, float]]:
    """Return the measurements in a file of ``store``, or all stored ones.

    Raises:
        DataError: when the file is missing or malformed, or its board's profile has changed.
    """
    questions = []
    for path in [file] if file else sorted(calibrations().glob("*.json")):
        try:
            questions += [(item.question(), item.ms) for item in _read(path) if file or item.profile in profile_names()]
        except ProfileError as error:
            raise DataError(f"The calibration {path} does not fit any more: {error.message}", REDO_FIX) from error
    return questions


def _read(file: Path) -> list[BoardMeasurement]:
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        measured = [BoardMeasurement(**row) for row in data["measured"]]
    except OSError as error:
        raise DataError(f"The calibration {file} cannot be read: {error.strerror}.", REDO_FIX) from error
    except (ValueError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise DataError(f"The calibration {file} is malformed: {type(error).__name__}: {error}.", REDO_FIX) from error
    for item in measured:
        if not is_valid(item):
            raise DataError(f"The calibration {file} is malformed: {item}.", REDO_FIX)
    return measured


def is_valid(item: BoardMeasurement) -> bool:
    """Return whether a measurement is usable: names, numbers above zero, a known precision, known traits."""
    named = (item.profile, item.mode, item.engine, item.precision)
    if not isinstance(item.work, Mapping) or not all(isinstance(name, str) for name in named):
        return False
    numbers = [item.ms, *(item.work.get(name) for name in NUMBERS)]
    traits = item.work.get("traits")
    return (
        all(isinstance(value, int | float) and math.isfinite(value) and value > 0 for value in numbers)
        and item.precision in PRECISIONS
        and isinstance(traits, list | tuple)
        and set(map(str, traits)) <= set(TRAITS)
    )
