"""A claim of a gate: its options in the gate file, the evidence that it needs, how it is examined, and its wording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic import ConfigDict

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, PluginError
from vlatool.files.numbers import Numeric
from vlatool.gate.evidence import Evidence, recorded_data
from vlatool.gate.plan import Need, Plan
from vlatool.gate.verdict import Judgement, Verdict

KIND = "claims"


class Claim(Numeric):
    """Base of the claims; each is one file, found by its name. The fields are the claim's options in a gate file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    needs: ClassVar[frozenset[Need]] = frozenset()
    """Evidence that ``examine`` uses."""
    by_default: ClassVar[bool] = False
    """Whether the claim is examined if the gate file does not mention it."""
    order: ClassVar[int] = 100
    """Position in a gate file, and among claims with the same needs."""
    example: ClassVar[str] = ""
    """Lines for a new gate file; the name and the first line of the docstring when empty."""

    @classmethod
    def name(cls) -> str:
        """Return the name of the claim in a gate file."""
        return registry.entry_of(cls).partition(".")[2]

    @property
    def paths(self) -> dict[str, Path]:
        """Options that name files for the gate to read, relative to the gate file."""
        return {name: value for name, value in self if isinstance(value, Path)}

    def extend_plan(self, plan: Plan) -> Plan:
        """Return the plan with the needs of this claim added."""
        return replace(plan, needs=plan.needs | self.needs)

    def check(self, baseline: Bundle, plan: Plan) -> None:
        """Refuse a claim that cannot be examined, before anything is measured.

        Raises:
            DataError: when the claim needs recordings, and neither the gate file nor the baseline has any.
        """
        if Need.RECORDINGS in self.needs and recorded_data(baseline, plan) is None:
            raise DataError(
                f"The claim '{self.name()}' needs recorded observations; neither gate file nor baseline has any.",
                "name recorded data in the gate (accuracy: data)",
            )

    def examine(self, evidence: Evidence) -> Verdict:
        """Return the verdict, as values; raises VlatoolError when something cannot be measured."""
        raise PluginError(f"The claim {self.name()} has no method examine().", "define examine(self, evidence)")

    def verdicts(self, evidence: Evidence) -> dict[str, Verdict]:
        """Return title -> verdict; several if the claim is examined more than once."""
        return {self.name(): self.examine(evidence)}

    def sentence(self, verdict: Verdict) -> str:
        """Return the verdict as a sentence without a full stop."""
        return "; ".join(map(measured_words, verdict.decisive)) or verdict.reason.value


def measured_words(judged: Judgement) -> str:
    """Return ``TITLE VALUE UNIT (LOW to HIGH; allowed: LIMIT)``, or the reason why there is no value."""
    measured = judged.measured
    if measured is None:
        return f"{judged.title}: {judged.reason.value}" if judged.title else judged.reason.value
    unit = "" if measured.unit == "1" else f" {measured.unit}"
    span = "" if measured.low is None or measured.high is None else f"{measured.low:.4g} to {measured.high:.4g}; "
    allowed = "" if judged.limit is None else f"allowed: {judged.limit:.4g}{unit}"
    return f"{judged.title or measured.name} {measured.value:.4g}{unit} ({span}{allowed})"
