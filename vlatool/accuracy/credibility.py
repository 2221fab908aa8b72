"""Credibility of the reference: whether it does its task better than actions that ignore the observation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from vlatool.measures import actions
from vlatool.measures.success import SUCCESS, SUCCESS_CHANCE
from vlatool.report import Measurement, Row
from vlatool.stats.intervals import wilson

DECIDE = (SUCCESS.name, SUCCESS_CHANCE.name, actions.SKILL_EXPERT.name, actions.VARIATION.name)
"""The measurements that the credibility rests on."""
SKILL = 0.1
"""Share of the best constant action's error that a credible policy does not make, at least."""
MIN_EPISODES = 100
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


class Trust(str, Enum):
    """Whether the reference does its task; unknown where nothing says what is right."""

    CREDIBLE = "credible"
    FAILS = "fails"
    UNKNOWN = "unknown"


class Ground(Enum):
    """Ground of the verdict on the reference, or of the lack of one; the value is the text about it."""

    UNASKED = ""
    NOTHING_RIGHT = (
        "whether the reference does its task is unmeasured: there is no environment and no expert's action; at "
        "most the distance from it was judged"
    )
    CHANCE_UNMEASURED = "what succeeds by chance in this environment was not measured"
    NEVER_SUCCEEDS = "{name} succeeds in none of {own.samples} closed-loop episodes"
    NOT_ABOVE_CHANCE = (
        "{name} succeeds in {own.value:.1%} of {own.samples} closed-loop episodes, and actions that do not look at "
        "the observation in {chance.value:.1%} of {chance.samples}, which cannot tell them apart"
    )
    ABOVE_CHANCE = (
        "{name} succeeds in {own.value:.1%} of {own.samples} episodes; actions that do not look at the "
        "observation in {chance.value:.1%} of {chance.samples}."
    )
    ONE_ACTION = "{name} gives the same action to all of {own.samples} recorded observations"
    SKILL_UNKNOWN = "{own.note} ({own.samples} recorded observations)"
    NO_SKILL = (
        "{name} makes {error:.1%} of the error of the best constant action on {own.samples} recorded observations "
        f"(at most {{most:.1%}}; a policy that looks makes less than {1 - SKILL:.0%})"
    )
    HARDLY_VARIES = (
        "the actions of {name} hardly vary: {own.value:.1%} of the expert's standard deviation on {own.samples} "
        "recorded observations"
    )
    BEATS_CONSTANT = (
        "{name} makes {error:.1%} of the error of the best constant action on {own.samples} recorded observations."
    )


IN_EPISODES = (Ground.NEVER_SUCCEEDS, Ground.NOT_ABOVE_CHANCE)


@dataclass(frozen=True)
class Credibility:
    """Verdict on the reference, and its grounds.

    Args:
        verdict: credible, fails, or unknown.
        own: number that decides; None where there is none.
        chance: success rate by chance, where success rates decide.
        table: comparisons with floors.
        reservations: further findings, which do not decide.
    """

    verdict: Trust = Trust.UNKNOWN
    ground: Ground = Ground.UNASKED
    name: str = ""
    own: Measurement | None = None
    chance: Measurement | None = None
    table: tuple[dict[str, Any], ...] = ()
    reservations: tuple[Credibility, ...] = ()

    @property
    def fails(self) -> bool:
        """Whether nothing that is compared with the reference means anything."""
        return self.verdict is Trust.FAILS

    @property
    def sentences(self) -> tuple[str, ...]:
        """The finding, and what to look at, when the reference fails."""
        if not self.fails:
            return ()
        few = self.own and self.chance and max(self.own.samples, self.chance.samples) < MIN_EPISODES
        look_at = LOOK_AT_WORLD if self.ground in IN_EPISODES else LOOK_AT
        return (f"The reference fails, so that nothing can be held against it: {self._words}.",
                f"{look_at} More --episodes would narrow that." if few else look_at)  # fmt: skip

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reservations that a reader should know although they do not decide."""
        own = (self._words,) if self.verdict is Trust.UNKNOWN and self.ground is not Ground.UNASKED else ()
        return (*(text for other in self.reservations for text in (*other.warnings, *other.sentences[:1])), *own)

    @property
    def floor(self) -> str:
        """The floor that the reference was compared with, in a sentence, when it is credible."""
        return self._words if self.verdict is Trust.CREDIBLE else ""

    @property
    def _words(self) -> str:
        own = self.own or Measurement("", math.nan, "1")
        error, most = 1 - own.value, 1 - (own.low or 0.0)
        return self.ground.value.format(name=self.name, own=own, chance=self.chance, error=error, most=most)


def credibility(row: Row, name: str = "the reference") -> Credibility:
    """Judge the reference by its episodes where there are some, else by the expert's recorded actions.

    Args:
        row: row with ``success`` and ``success_chance`` (the better control on some of the same seeds), or with
            ``skill_expert`` and ``variation``, as the stages of ``vlatool.evaluate`` measure them.
    """
    recorded, played = (replace(judged, name=name) for judged in (_recorded(row), _played(row)))
    table = (*recorded.table, *played.table)
    if played.verdict is Trust.UNKNOWN:
        return replace(recorded, table=table, reservations=(played,))
    reservations = (recorded,) if recorded.fails and not played.fails else ()
    return replace(played, table=table, reservations=reservations)


def _played(row: Row) -> Credibility:
    own, chance = row.get(SUCCESS), row.get(SUCCESS_CHANCE)
    if own is None:
        return Credibility()
    if own.value == 0.0:
        return Credibility(Trust.FAILS, Ground.NEVER_SUCCEEDS, own=own)
    if chance is None:
        return Credibility(ground=Ground.CHANCE_UNMEASURED)
    gain = lower_bound(own, chance)
    line = {
        "measure": SUCCESS.name, "reference": round(own.value, 4), "by chance": round(chance.value, 4),
        "floor": "the difference is above 0 with 95 % confidence", "found": f"at least {gain:+.1%}",
    }  # fmt: skip
    if gain > 0:
        return Credibility(Trust.CREDIBLE, Ground.ABOVE_CHANCE, own=own, chance=chance, table=(line,))
    return Credibility(Trust.FAILS, Ground.NOT_ABOVE_CHANCE, own=own, chance=chance, table=(line,))


def lower_bound(own: Measurement, chance: Measurement) -> float:
    """Return the lower bound, at 95 %, of the difference of two success rates (Newcombe 1998, method 10).

    Args:
        own, chance: success rates with their Wilson intervals, which allow for episodes that begin alike; without one,
            those of ``samples`` independent episodes are used.
    """
    low = wilson(round(own.value * own.samples), own.samples)[0] if own.low is None else own.low
    high = wilson(round(chance.value * chance.samples), chance.samples)[1] if chance.high is None else chance.high
    return own.value - chance.value - math.hypot(own.value - low, high - chance.value)


def _recorded(row: Row) -> Credibility:
    skill, varied = row.get(actions.SKILL_EXPERT), row.get(actions.VARIATION)
    if varied is not None and varied.value == 0.0:
        return Credibility(
            Trust.FAILS, Ground.ONE_ACTION, own=varied, table=(_line(actions.VARIATION.name, varied, "above 0"),)
        )
    if skill is None:
        return Credibility(ground=Ground.NOTHING_RIGHT)
    floor = f"{SKILL:g}, and above 0 with 95 % confidence"
    table: tuple[dict[str, Any], ...] = (_line("skill against the best constant action", skill, floor),)
    if not skill.known:
        return Credibility(Trust.FAILS, Ground.SKILL_UNKNOWN, own=skill, table=table)
    if not (skill.value >= SKILL and (skill.low or 0.0) > 0):
        return Credibility(Trust.FAILS, Ground.NO_SKILL, own=skill, table=table)
    if varied is not None and row.get(actions.ERROR_EXPERT) is not None:
        table = (*table, _line("variation by that of the expert", varied, f"{VARIATION:g}"))
        if varied.value < VARIATION:
            return Credibility(Trust.FAILS, Ground.HARDLY_VARIES, own=varied, table=table)
    return Credibility(Trust.CREDIBLE, Ground.BEATS_CONSTANT, own=skill, table=table)


def _line(measure: str, measured: Measurement, floor: str) -> dict[str, Any]:
    bounds = "" if measured.low is None else f"{measured.low:.4g} to {measured.high:.4g}"
    value = measured.value if measured.known else None
    return {"measure": measure, "reference": value and round(value, 4), "by chance": 0, "floor": floor, "found": bounds}
