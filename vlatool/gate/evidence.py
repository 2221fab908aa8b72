"""Evidence for the claims of a gate: both bundles, and their measurements."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import NamedRecording, recordings_of
from vlatool.errors import PluginError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.gate.inputs import Inputs
from vlatool.gate.plan import Need, Plan
from vlatool.gate.timing_processes import Timed
from vlatool.measurement.agreement import Agreement
from vlatool.report import Row
from vlatool.stage.base import Context


@dataclass(frozen=True)
class Evidence:
    """Both bundles and their measurements, most of which are made when a claim first asks for them.

    Args:
        timed: processes that time both bundles, measured one by one (needs ``Need.TIMES``).
        answers: answers of both to observations drawn afresh; read it as ``agreement``.
    """

    candidate: Bundle
    baseline: Bundle
    plan: Plan
    context: Context
    inputs: Inputs
    timed: Timed
    answers: Agreement

    @property
    def agreement(self) -> Agreement:
        """Answers of both bundles to observations drawn afresh (needs ``Need.AGREEMENT``)."""
        self._require(Need.AGREEMENT)
        return self.answers

    @property
    def recording_path(self) -> Path | None:
        """The recorded observations that both are compared on: those of the gate file, else the baseline's own."""
        return recorded_data(self.baseline, self.plan)

    @property
    def recording(self) -> NamedRecording | None:
        """The same, with the names that the gate file maps."""
        path, plan = self.recording_path, self.plan
        return None if path is None else NamedRecording(path, plan.names if plan.data else {})

    @cached_property
    def episodes(self) -> tuple[Row, Row]:
        """The baseline's row, with what succeeds by chance, and the candidate's (needs ``Need.EPISODES``).

        The same episodes of both, played once for all claims.

        Raises:
            DataError: when no environment is named, or it fails.
        """
        self._require(Need.EPISODES)
        plan = self.plan
        options: dict[str, Any] = {"episodes": plan.episodes, "baseline": self.baseline.path, "policy": plan.policy}
        options |= {"engine": plan.engine}
        if plan.disturb:
            options |= {"disturb": plan.disturb, "strength": plan.strength}
        stage = ClosedLoop(**options)
        stage.check(self.candidate, None)
        baseline, candidate = stage.run(self.candidate, self.context).rows
        return baseline, candidate

    def _require(self, need: Need) -> None:
        if need not in self.plan.needs:
            raise PluginError(f"A claim looks at {need.name.lower()} without being due.", "name it in its `needs`")


def recorded_data(baseline: Bundle, plan: Plan) -> Path | None:
    """Return the recorded observations that bundles are compared on; None when there are none.

    They are the gate's or the baseline's, never the candidate's: it would choose what it is judged on.
    """
    return plan.data or recordings_of(baseline).evaluation
