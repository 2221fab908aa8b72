"""What a profile's board would need for a bundle, as predictions that say so."""

from __future__ import annotations

from vlatool.boards.board import Candidate, outcomes
from vlatool.boards.measured import measured_questions
from vlatool.boards.report import numbers
from vlatool.bundle.bundle import Bundle
from vlatool.graph.workload import workload
from vlatool.hardware.profile import Profile
from vlatool.latency_model.model import shipped
from vlatool.report import Measurement

SHOWN = ("latency_p50", "memory", "energy")


def predictions(profile: Profile, bundle: Bundle, engine: str = "") -> list[Measurement]:
    """Return predicted latency, memory and energy of a bundle on a board; NaN with a note where there is no ground.

    Args:
        profile: The board.
        bundle: With graphs.
        engine: Which engine of the board runs it; the bundle's own when empty, and where the board has that.
    """
    own = bundle.manifest.engine if bundle.manifest.engine in profile.engines else profile.engine
    engine = engine or own
    model = shipped().conditioned(measured_questions())
    outcome = outcomes([Candidate(profile, profile.default_mode, engine)], workload(bundle), model)[0]
    return [measurement for measurement in numbers(outcome) if measurement.name in SHOWN]
