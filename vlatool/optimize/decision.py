"""The decision: every row held against the limits, one of them chosen, and whether float32 does its task at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from vlatool.accuracy.credibility import Credibility, credibility
from vlatool.measures import with_derived
from vlatool.optimize.choice import choose, chosen_of
from vlatool.optimize.choice_apart import choose_apart
from vlatool.optimize.evidence import Enough
from vlatool.optimize.judge import Judged, judge
from vlatool.optimize.plan import BASELINE, Plan
from vlatool.optimize.ranking import is_faster
from vlatool.report import Row
from vlatool.runtime.engine import DEFAULT_ENGINE, is_installed

Tables = Mapping[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Decision:
    """What was decided.

    Args:
        judged: rows, held against the limits; float32 first, one of them chosen.
        trust: whether float32 does its task.
    """

    judged: tuple[Judged, ...]
    trust: Credibility

    @property
    def choice(self) -> Judged:
        """The row that is chosen."""
        return chosen_of(self.judged)

    @property
    def verdict(self) -> str:
        """``pass``, ``fail``, or ``inconclusive`` where nothing can be held against float32."""
        kept = self.choice.within and any(item.within for item in self.judged[1:])
        return "inconclusive" if self.trust.fails else "pass" if kept else "fail"

    def with_tables(self, tables: Tables) -> Decision:
        """Return the decision with tables that belong to the chosen row."""
        judged = (_with_tables(item, tables) if item is self.choice else item for item in self.judged)
        return replace(self, judged=tuple(judged))


def decide(plan: Plan, rows: Mapping[str, Row], engines: Mapping[str, str] | None = None) -> Decision:
    """Hold every row against the limits of a plan, choose one, and say whether float32 does its task.

    Args:
        rows: name -> row with everything that was measured and predicted, float32 first.
        engines: name -> engine of each candidate; needed where the engines cannot be compared.
    """
    limits, profile, on_board, base = plan.recipe.limits, plan.profile, plan.on_board, rows[BASELINE]
    trust, small = credibility(base, BASELINE), limits.max_memory_mb is not None
    judged = [judge(row, base, limits, profile, on_board) for row in rows.values()]
    if profile and plan.board_set.is_confined:
        judged = choose_apart(judged, engines or {}, tuple(profile.engines), plan.board_set, small)
    else:
        board = "" if on_board else plan.board
        judged = choose(judged, profile.engine if profile else DEFAULT_ENGINE, small, board)
    table = {"Whether the reference does its task": list(trust.table)} if trust.table else {}
    return Decision((_with_tables(judged[0], table), *judged[1:]), trust)


def _with_tables(item: Judged, tables: Tables) -> Judged:
    return replace(item, row=replace(item.row, details={**item.row.details, **tables}))


def enough_for(plan: Plan) -> Enough | None:
    """Return what ends the episodes: a candidate that keeps to the limits, where measured latencies decide."""
    board = plan.profile.engine if plan.profile else DEFAULT_ENGINE
    if plan.recipe.effort.every_candidate or plan.board_set.is_confined or not is_installed(board):
        return None

    def is_good_enough(row: Row, baseline: Row) -> bool:
        judged = judge(with_derived(row), baseline, plan.recipe.limits, plan.profile, plan.on_board)
        return judged.within and is_faster(row, baseline)

    return is_good_enough
