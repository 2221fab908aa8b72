"""Predictions for a bundle on the board of a profile."""

from __future__ import annotations

import math
from dataclasses import replace

from vlatool.bundle.bundle import Bundle
from vlatool.graph.workload import workload
from vlatool.hardware.profile import Profile
from vlatool.latency_model.board import Candidate, Outcome, engine_for, outcomes, stored_quantization
from vlatool.latency_model.board_measurements import measured_questions
from vlatool.latency_model.model import LEVEL, Prediction, load_model
from vlatool.measures.latency import LATENCY_P50, LATENCY_PER_ACTION
from vlatool.measures.resources import ENERGY, ENERGY_PER_ACTION, MEMORY, USABLE_MEMORY, WATTS
from vlatool.report import Measurement

SHOWN_QUANTITIES = (LATENCY_P50.name, MEMORY.name, ENERGY.name)


def predictions(profile: Profile, bundle: Bundle, engine: str = "") -> list[Measurement]:
    """Return predicted latency, memory and energy of a bundle on a board; NaN with a note where unknown.

    Args:
        engine: Engine of the board; when empty, the bundle's own, where the board has that, or its preferred one, where
            it runs such graphs, or another one that does.
    """
    load, model = workload(bundle), load_model().condition(measured_questions())
    engine = engine or engine_for(profile, load, bundle.manifest.engine)
    outcome = outcomes([Candidate(profile, profile.default_mode, engine or profile.engine)], load, model)[0]
    if not engine:
        why = f"no engine of {profile.name} runs this bundle, whose graphs are {stored_quantization(load)}"
        outcome = replace(outcome, latency=Prediction(math.nan, why=why))
    return [measurement for measurement in numbers(outcome) if measurement.name in SHOWN_QUANTITIES]


def numbers(outcome: Outcome, execute: int = 1) -> list[Measurement]:
    """Return latency, memory, power and energy of an inference as predictions, and of each action executed of it."""
    where, latency = outcome.candidate.profile.name, outcome.latency
    way = f"{outcome.candidate.engine}, power mode {outcome.candidate.mode}"
    note = latency.why or f"{way}: {EVIDENCE[latency.regime]}; without pre- and postprocessing"
    low, high = (latency.low, latency.high) if latency.known else (None, None)
    memory, power = outcome.memory_mb, outcome.watts
    usable = 1e3 * outcome.candidate.profile.usable_memory_gb.value

    measurements = [
        LATENCY_P50.prediction(latency.ms, where, low, high, LEVEL, note),
        MEMORY.prediction(memory[0], where, memory[1], memory[2], LEVEL, BOUNDS_NOTE),
        USABLE_MEMORY.prediction(usable, where),
        WATTS.prediction(power[0], where, power[1], power[2], LEVEL, BOUNDS_NOTE),
    ]
    if latency.known:
        ends = (power[1] * latency.low / 1e3, power[2] * latency.high / 1e3)
        measurements.append(ENERGY.prediction(outcome.joules, where, *ends, LEVEL, BOUNDS_NOTE))
        for quantity, value in ((LATENCY_PER_ACTION, latency.ms), (ENERGY_PER_ACTION, outcome.joules)):
            measurements.append(quantity.prediction(value / execute, where))
    return measurements


EVIDENCE = {
    "known": "this runtime and precision were measured on this device",
    "unseen": "from other devices, runtimes or precisions",
    "calibrated": "with your own measurement on this device",
}
BOUNDS_NOTE = "bounds are a judgement, not a confidence interval"
