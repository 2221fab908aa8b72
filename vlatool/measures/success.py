"""How often episodes succeed, and how much less often than of what a variant is held against."""

from __future__ import annotations

from vlatool.measures import HEADLINE, MOTION, PLAIN, POINTS, Quantity

WILSON = "Wilson, for as many episodes as the distinct starts are worth"
EXACT = "exact, of discordant pairs"

SUCCESS = Quantity("success", "1", better="more", section=HEADLINE, order=40, interval=WILSON)
SUCCESS_DROP = Quantity("success_drop", "1", section=HEADLINE, order=50, column="drop", form=POINTS, interval=EXACT)
SUCCESS_CHANCE = Quantity("success_chance", "1", "success by chance", "", interval=WILSON)
SUCCESS_WRONG_INSTRUCTION = Quantity(
    "success_wrong_instruction", "1", "success with the wrong instruction", interval=WILSON
)
MCNEMAR_P = Quantity("mcnemar_p", "1", "McNemar p", "", form=PLAIN)
SUCCESS_DISTURBED = Quantity("success_disturbed", "1", better="more", section=MOTION, order=30, interval="Wilson")
DISTURBED_DROP = Quantity("disturbed_drop", "1", form=POINTS, interval=f"{EXACT}, Bonferroni over disturbances")
WORST_TASK_DROP = Quantity(
    "worst_task_drop", "1", section=MOTION, order=40, form=POINTS, interval=f"{EXACT}, Bonferroni over tasks"
)
