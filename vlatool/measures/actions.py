"""How far actions are from the expert's, or from a baseline's, and how much they say about the observation."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.measures import ELEMENTS, PLAIN, POINTS, RECORDED_ACCURACY, Family, Quantity


def _by_element(name: str, title: str) -> Family:
    return Family(
        Quantity(f"{name}.{{element}}", "", f"{title}, {{element}}", section=ELEMENTS, form=PLAIN, group=title)
    )


AGREEMENT_EXPERT = Quantity(
    "agreement_expert", "1", "agreement vs expert", "more", RECORDED_ACCURACY, 61, interval="Wilson"
)
AGREEMENT_BASELINE = Quantity(
    "agreement_baseline", "1", "agreement vs baseline", "more", RECORDED_ACCURACY, 62, interval="Wilson"
)
ERROR_EXPERT = Quantity("error_expert", "1", "error vs expert", section=RECORDED_ACCURACY, order=63, form=PLAIN)
ERROR_BASELINE = Quantity("error_baseline", "1", "error vs baseline", section=RECORDED_ACCURACY, order=64, form=PLAIN)
ERROR_EXPERT_OF = _by_element("error_expert", "error vs expert")
ERROR_BASELINE_OF = _by_element("error_baseline", "error vs baseline")
ERROR_MAX_OF, ERROR_OF = _by_element("error_max", "error max"), _by_element("error", "error")
GRIPPER_FLIPS_EXPERT = Quantity("gripper_flips_expert", "1", "gripper flips vs expert", interval="Wilson")
GRIPPER_FLIPS_BASELINE = Quantity("gripper_flips_baseline", "1", "gripper flips vs baseline", interval="Wilson")
RELATIVE_ERROR = Quantity("relative_error", "1", "relative error (L2)")
RELATIVE_ERROR_MAX = Quantity("relative_error_max", "1")
RAW_RELATIVE_ERROR = Quantity("raw_relative_error", "1", "relative error (L2) of the raw action")
GOLDEN_ERROR = Quantity("golden_error", "1")
SKILL_EXPERT = Quantity(
    "skill_expert", "1", "skill against a constant action", "more", form=PLAIN, interval="Student's, over episodes"
)
VARIATION = Quantity("variation", "1", "variation of the actions", "", form=PLAIN)
FOLLOWS = Quantity("follows", "1", better="more")

AGREEMENT_DROP = Quantity("agreement_drop", "1", form=POINTS)
ERROR_INCREASE = Quantity("error_increase", "1", form=PLAIN)
DISAGREEMENT = Quantity("disagreement", "1")
RECORDED_DROP = Quantity("recorded_drop", "1", form=POINTS, interval="the widest of bootstrap, Student's and paired")


@dataclass(frozen=True)
class Reference:
    """What actions are compared with, and the quantities of the comparison.

    Args:
        name: ``expert`` or ``baseline``.
        agreement: Share of equal discrete actions.
        error: Mean absolute error, each element by its standard deviation.
        element_error: Mean absolute error of one element, in its unit.
        gripper_flips: Share of steps in which a gripper is on the other side of its middle.
    """

    name: str
    agreement: Quantity
    error: Quantity
    element_error: Family
    gripper_flips: Quantity


EXPERT = Reference("expert", AGREEMENT_EXPERT, ERROR_EXPERT, ERROR_EXPERT_OF, GRIPPER_FLIPS_EXPERT)
BASELINE = Reference("baseline", AGREEMENT_BASELINE, ERROR_BASELINE, ERROR_BASELINE_OF, GRIPPER_FLIPS_BASELINE)
