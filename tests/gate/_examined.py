"""A claim examined on evidence that is made up, with its verdict and its words side by side."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.gate.claim import Claim
from vlatool.gate.evidence import Evidence
from vlatool.gate.inputs import Inputs
from vlatool.gate.plan import Plan
from vlatool.gate.verdict import Verdict
from vlatool.measurement.agreement import Agreement
from vlatool.report import Measurement
from vlatool.stage.base import Context


@dataclass(frozen=True)
class Found:
    claim: str
    verdict: str
    sentence: str
    measurements: tuple[Measurement, ...]
    baseline: tuple[Measurement, ...]


def all_found(claim: Claim, **evidence: Any) -> list[Found]:
    """Examine a claim on the attributes of ``Evidence`` that it looks at."""
    verdicts = claim.verdicts(SimpleNamespace(**evidence))  # type: ignore[arg-type]
    return [of(title, verdict, claim) for title, verdict in verdicts.items()]


def found(claim: Claim, **evidence: Any) -> Found:
    """The same of a claim with one verdict."""
    (only,) = all_found(claim, **evidence)
    return only


def of(title: str, verdict: Verdict, claim: Claim) -> Found:
    return Found(title, verdict.outcome.value, claim.sentence(verdict), verdict.measurements, verdict.baseline)


def of_bundles(candidate: Bundle, baseline: Bundle, claim: Claim, **planned: Any) -> Found:
    """Examine a claim on two bundles that are run."""
    plan = claim.extend_plan(Plan(**planned))
    inputs = Inputs(baseline, plan.data, 0)
    evidence = Evidence(candidate, baseline, plan, Context(), inputs, None, Agreement())  # type: ignore[arg-type]
    return of(claim.name(), claim.examine(evidence), claim)
