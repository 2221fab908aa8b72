"""Hold a candidate against a baseline: every claim of a gate, measured anew with both side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from vlatool.benchmark._pairs import Job
from vlatool.benchmark._trust import busy, throttled, validity
from vlatool.bundle import Bundle
from vlatool.claims import accuracy, deadline, growth, latency
from vlatool.claims._found import Found, worst
from vlatool.claims._timed import Timed
from vlatool.errors import BundleError
from vlatool.gate import Gate, LatencyClaim
from vlatool.host import before_run
from vlatool.report import Measurement, Report, Row
from vlatool.runtime.policy import refuse_findings
from vlatool.spec import TensorSpec
from vlatool.stage import Context
from vlatool.telemetry import Recorder, open_all

KIND = "gate"
PERIOD_S = 1.0
"""Seconds between two looks at the board."""


def run_gate(candidate: Bundle, baseline: Bundle, gate: Gate, context: Context, seed: int = 0) -> Report:
    """Examine every claim of a gate; what is cheap first.

    Args:
        candidate, baseline: Bundles with graphs, of one spec.
        gate: What is claimed.
        context: Progress and workers.
        seed: Of the order in which bundles are loaded and called.

    Raises:
        BundleError: when a bundle has no graph, or the two have other inputs or outputs.
        DataError: when accuracy is claimed and there is nothing to measure it on.
        GraphError: when a bundle cannot be run, or hangs.
    """
    _check(candidate, baseline, gate)
    host = before_run()
    how = gate.latency or LatencyClaim()
    paths = (str(baseline.path), str(candidate.path))
    timed = Timed(Job(*paths, how.engine, how.threads, how.warmup, how.pairs, how.seconds, seed), context, how.timeout)
    found: list[Found] = []
    if gate.size:
        found.append(growth.examine_size(candidate, baseline, gate.size))
    if gate.memory:
        found.append(growth.examine_memory(candidate, baseline, gate.memory, how, context))
    if gate.accuracy:
        found.append(accuracy.examine(candidate, baseline, gate.accuracy, context))
    with Recorder(open_all(), PERIOD_S) as board:
        if gate.latency:
            found.append(latency.examine(timed, gate.latency))
        if gate.deadline:
            found.append(deadline.examine(timed, gate.deadline))
    seen = (*throttled(board.recorded.throttling), *(replace(each, effect="note") for each in busy(host)))
    name = candidate.manifest.name
    rows = (_row("baseline", baseline, timed, found), _row("candidate", candidate, timed, found))
    return Report(KIND, f"Gate of {name}", worst(each.verdict for each in found), _summary(name, found), rows,
                  command=context.command, environment=host, validity=validity(seen), findings=seen)  # fmt: skip


def _check(candidate: Bundle, baseline: Bundle, gate: Gate) -> None:
    for bundle in (candidate, baseline):
        if not bundle.manifest.graphs:
            raise BundleError(f"{bundle.path} has no graph to run.", "export it first: vlatool export SOURCE -o BUNDLE")
        refuse_findings(bundle, gate.accept)
    for kind in ("inputs", "outputs"):
        mine, theirs = (
            {each.name: each for each in getattr(bundle.manifest.spec, kind)} for bundle in (candidate, baseline)
        )
        for name in {**theirs, **mine}:
            if differs := _differs(mine.get(name), theirs.get(name)):
                both = f"{candidate.path} and {baseline.path} are no versions of one policy"
                raise BundleError(f"{both}: {kind[:-1]} {name}: {differs}.")
    if gate.accuracy:
        accuracy.data_of(candidate, gate.accuracy)


MEANING = ("shape", "dtype", "kind", "unit", "labels", "mode")
"""What a robot relies on; files of statistics and tokenizers may differ."""


def _differs(mine: TensorSpec | None, theirs: TensorSpec | None) -> str:
    """Return in words how an input or output of the candidate differs from the baseline's; nothing when it does not."""
    if mine is None or theirs is None:
        return f"it is in the {'baseline' if mine is None else 'candidate'} alone"
    pairs = [(name, getattr(mine, name), getattr(theirs, name)) for name in MEANING]
    return "; ".join(f"{name} {list(one) if isinstance(one, tuple) else one!r} in the candidate, "
                     f"{list(two) if isinstance(two, tuple) else two!r} in the baseline"
                     for name, one, two in pairs if one != two)  # fmt: skip


def _row(name: str, bundle: Bundle, timed: Timed, found: Sequence[Found]) -> Row:
    calls = timed.calls(name)
    measured = [Measurement("latency_p50", median(calls), "ms", samples=len(calls))] if calls else []
    raw = {"latency_ms": calls} if calls else {}
    reason = f"{bundle.manifest.name}, {bundle.hash[:19]}"
    if name == "baseline":
        measured += [each for claim in found for each in claim.baseline]
        return Row(name, "baseline", reason, tuple(measured), raw)
    measured += [each for claim in found for each in claim.measurements]
    raw |= {"log_ratio": [pairs.log_ratio for pairs in timed.pairs]} if calls else {}
    claims = [{"claim": each.claim, "verdict": each.verdict, "found": each.sentence} for each in found]
    return Row(name, "subject", reason, tuple(measured), raw, {"claims": claims})


def _summary(name: str, found: Sequence[Found]) -> tuple[str, ...]:
    """Return the result, then every claim in a sentence, those that failed first."""
    order = ("fail", "inconclusive", "pass")
    named = {verdict: ", ".join(each.claim for each in found if each.verdict == verdict) for verdict in order}
    first = {
        "pass": f"{name} keeps to every claim: {named['pass']}.",
        "fail": f"{name} does not keep to: {named['fail']}.",
        "inconclusive": f"The samples cannot decide about {named['inconclusive']} of {name}.",
    }[worst(each.verdict for each in found)]
    said = sorted(found, key=lambda each: order.index(each.verdict))
    return (first, *(f"{each.claim}: {each.verdict}: {each.sentence}." for each in said))
