"""Whether the policy that everything is held against does its task at all, better than who does not look."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from vlatool.measures import actions
from vlatool.measures.success import SUCCESS, SUCCESS_CHANCE
from vlatool.report import Measurement, Row
from vlatool.stats.intervals import wilson

DECIDE = (SUCCESS.name, SUCCESS_CHANCE.name, actions.SKILL_EXPERT.name, actions.VARIATION.name)
"""The measurements that the credibility rests on."""
FAILS = "The reference fails"
"""How the sentence about a reference begins that does not do its task."""
SKILL = 0.1
"""Share of the best constant action's error that a credible policy does not make, at least."""
FEW = 100
"""Episodes below which a failure may be one of numbers alone."""
VARIATION = 0.1
"""Least standard deviation of a credible policy's actions, by that of the expert's."""
LOOK_AT = (
    "Look at the wrapper (are all layers and weights there?), the order of the cameras and their colours, the "
    "statistics and units of inputs and actions, the instruction, and what the data calls right."
)
LOOK_AT_WORLD = (
    "Look at the environment's success (info['success'] or info['is_success']), the wrapper (are all layers and "
    "weights there?), the order of the cameras, the statistics and units of inputs and actions, and the instruction."
)


@dataclass(frozen=True)
class Credibility:
    """What is known of the reference.

    Args:
        verdict: ``credible``, ``fails``, or ``unknown`` where nothing says what is right.
        sentences: When it fails: what was found and what to look at.
        warnings: What a reader should know although it does not decide.
        table: What was compared with which floor.
        floor: The same in a sentence, when it is credible.
    """

    verdict: str
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    table: tuple[dict[str, Any], ...] = ()
    floor: str = ""

    @property
    def fails(self) -> bool:
        """Whether nothing that is compared with the reference means anything."""
        return self.verdict == "fails"


UNKNOWN = (
    "whether the reference does its task is unmeasured: there is no environment and no expert's action; at "
    "most the distance from it was judged"
)


def credibility(row: Row, name: str = "the reference") -> Credibility:
    """Judge the reference by its episodes where there are some, else by the expert's recorded actions.

    Args:
        row: With ``success`` and ``success_chance`` (the better control on some of the same seeds), or ``skill_expert``
            and ``variation``, as the stages of ``vlatool.evaluate`` measure them.
        name: What the sentences call it.
    """
    judged = _recorded(row, name), _played(row, name)
    recorded, played = judged
    table = tuple(line for part in judged for line in part.table)
    if played.verdict != "unknown":
        warnings = tuple(told for told in recorded.sentences[:1] if not played.fails)
        return Credibility(played.verdict, played.sentences, (*played.warnings, *warnings), table, played.floor)
    warnings = (UNKNOWN,) if recorded.verdict == "unknown" else recorded.warnings
    return Credibility(recorded.verdict, recorded.sentences, (*played.warnings, *warnings), table, recorded.floor)


def _failing(reason: str, look_at: str, table: tuple[dict[str, Any], ...] = ()) -> Credibility:
    first = f"{FAILS}, so that nothing can be held against it: {reason}."
    return Credibility("fails", (first, look_at), table=table)


def _played(row: Row, name: str) -> Credibility:
    own, chance = row.get(SUCCESS), row.get(SUCCESS_CHANCE)
    if own is None:
        return Credibility("unknown")
    if own.value == 0.0:
        return _failing(f"{name} succeeds in none of {own.samples} closed-loop episodes", LOOK_AT_WORLD)
    if chance is None:
        return Credibility("unknown", warnings=("what succeeds by chance in this environment was not measured",))
    gain = above(own, chance)
    line = {
        "measure": SUCCESS.name, "reference": round(own.value, 4), "by chance": round(chance.value, 4),
        "floor": "the difference is above 0 with 95 % confidence", "found": f"at least {gain:+.1%}",
    }  # fmt: skip
    if gain > 0:
        floor = (
            f"{name} succeeds in {own.value:.1%} of {own.samples} episodes; actions that do not look at the "
            f"observation in {chance.value:.1%} of {chance.samples}."
        )
        return Credibility("credible", table=(line,), floor=floor)
    reason = (
        f"{name} succeeds in {own.value:.1%} of {own.samples} closed-loop episodes, and actions that do not look at "
        f"the observation in {chance.value:.1%} of {chance.samples}, which cannot tell them apart"
    )
    few = "" if max(own.samples, chance.samples) >= FEW else " More --episodes would narrow that."
    return _failing(reason, LOOK_AT_WORLD + few, (line,))


def above(own: Measurement, chance: Measurement) -> float:
    """Return the lower bound, at 95 %, of the difference of two success rates (Newcombe 1998, method 10).

    Args:
        own, chance: With their Wilson intervals, which allow for episodes that begin alike; those of ``samples``
            independent episodes where there is none.
    """
    low = wilson(round(own.value * own.samples), own.samples)[0] if own.low is None else own.low
    high = wilson(round(chance.value * chance.samples), chance.samples)[1] if chance.high is None else chance.high
    return own.value - chance.value - math.hypot(own.value - low, high - chance.value)


def _recorded(row: Row, name: str) -> Credibility:
    skill, varied = row.get(actions.SKILL_EXPERT), row.get(actions.VARIATION)
    if varied is not None and varied.value == 0.0:
        reason = f"{name} gives the same action to all of {varied.samples} recorded observations"
        return _failing(reason, LOOK_AT, (_line(actions.VARIATION.name, varied, "above 0"),))
    if skill is None:
        return Credibility("unknown")
    table: tuple[dict[str, Any], ...] = (
        _line("skill against the best constant action", skill, f"{SKILL:g}, and above 0 with 95 % confidence"),
    )
    if not skill.known:
        return _failing(f"{skill.note} ({skill.samples} recorded observations)", LOOK_AT, table)
    if not (skill.value >= SKILL and (skill.low or 0.0) > 0):
        reason = (
            f"{name} makes {1 - skill.value:.1%} of the error of the best constant action on {skill.samples} recorded "
            f"observations (at most {1 - (skill.low or 0.0):.1%}; a policy that looks makes less than {1 - SKILL:.0%})"
        )
        return _failing(reason, LOOK_AT, table)
    if varied is not None and row.get(actions.ERROR_EXPERT) is not None:
        table = (*table, _line("variation by that of the expert", varied, f"{VARIATION:g}"))
        if varied.value < VARIATION:
            reason = f"the actions of {name} hardly vary: {varied.value:.1%} of the expert's standard deviation"
            return _failing(f"{reason} on {varied.samples} recorded observations", LOOK_AT, table)
    floor = f"{name} makes {1 - skill.value:.1%} of the error of the best constant action on {skill.samples} recorded "
    return Credibility("credible", table=table, floor=f"{floor}observations.")


def _line(measure: str, measured: Measurement, floor: str) -> dict[str, Any]:
    bounds = "" if measured.low is None else f"{measured.low:.4g} to {measured.high:.4g}"
    value = measured.value if measured.known else None
    return {"measure": measure, "reference": value and round(value, 4), "by chance": 0, "floor": floor, "found": bounds}
