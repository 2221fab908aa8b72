"""A claim of a gate: its options in the gate file, what it needs, how it is examined, and its words."""

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
    """Base of the claims; each is one file, found by its name. Its fields are its options in a gate file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    needs: ClassVar[frozenset[Need]] = frozenset()
    """Evidence that the claim looks at."""
    by_default: ClassVar[bool] = False
    """Whether a gate file that does not name it claims it."""
    order: ClassVar[int] = 100
    """Position in a gate file, and among claims with the same needs."""
    example: ClassVar[str] = ""
    """Lines in a new gate file; its name and the first line of its docstring when empty."""

    @classmethod
    def name(cls) -> str:
        """Return its name in a gate file."""
        return registry.entry_of(cls).partition(".")[2]

    @property
    def paths(self) -> dict[str, Path]:
        """The options that name files: what the gate reads, relative to the gate file."""
        return {name: value for name, value in self if isinstance(value, Path)}

    def extend_plan(self, plan: Plan) -> Plan:
        """Return the plan with what this claim asks for."""
        return replace(plan, needs=plan.needs | self.needs)

    def check(self, baseline: Bundle, plan: Plan) -> None:
        """Refuse, before anything is measured, a claim that there is nothing to examine on.

        Raises:
            DataError: when it needs recordings, and neither the gate file nor the baseline has any.
        """
        if Need.RECORDINGS in self.needs and recorded_data(baseline, plan) is None:
            raise DataError(
                f"The claim '{self.name()}' needs recorded observations; neither gate file nor baseline has any.",
                "name recorded data in the gate (accuracy: data)",
            )

    def examine(self, evidence: Evidence) -> Verdict:
        """Return what is found, as values.

        Raises:
            VlatoolError: when something cannot be measured.
        """
        raise PluginError(f"The claim {self.name()} has no method examine().", "define examine(self, evidence)")

    def verdicts(self, evidence: Evidence) -> dict[str, Verdict]:
        """Return title -> verdict, where one claim is examined several times."""
        return {self.name(): self.examine(evidence)}

    def sentence(self, verdict: Verdict) -> str:
        """Return what was found in words, without a full stop."""
        return "; ".join(map(measured_words, verdict.decisive)) or verdict.reason.value


def measured_words(judged: Judgement) -> str:
    """Return ``TITLE VALUE UNIT (LOW to HIGH; allowed: LIMIT)``, or why there is not such a number."""
    measured = judged.measured
    if measured is None:
        return f"{judged.title}: {judged.reason.value}" if judged.title else judged.reason.value
    unit = "" if measured.unit == "1" else f" {measured.unit}"
    span = "" if measured.low is None or measured.high is None else f"{measured.low:.4g} to {measured.high:.4g}; "
    allowed = "" if judged.limit is None else f"allowed: {judged.limit:.4g}{unit}"
    return f"{judged.title or measured.name} {measured.value:.4g}{unit} ({span}{allowed})"
