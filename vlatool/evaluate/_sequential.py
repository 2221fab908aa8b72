"""Paired episodes in blocks over all tasks, until it is decided whether the drop is above a limit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from vlatool.accuracy.success_comparison import Outcome
from vlatool.episodes.play import EpisodesJob, jobs_for
from vlatool.files.printable import amount
from vlatool.measures import series
from vlatool.measures.success import SUCCESS_DROP
from vlatool.report import Row
from vlatool.stage.base import Context
from vlatool.stats.starts import distinct_starts, has_too_few_starts, independent_starts
from vlatool.stats.success_sequential import GO_ON, Decision, plan

Play = Callable[[list[EpisodesJob]], list[Outcome]]


def played_until(
    jobs: Sequence[EpisodesJob], limit: float, baseline: Play, variant: Play, context: Context
) -> tuple[list[Outcome], list[Outcome], Decision]:
    """Play the episodes of jobs, the same of both, and stop when the limit is decided or hardly can be.

    Args:
        jobs: jobs of ``jobs_for``: so many episodes at most.
        limit: The largest drop that passes, a share.
        baseline, variant: Play jobs with a bundle.

    Returns:
        Both lists of outcomes, task by task in the order of their seeds, and the decision.
    """
    tasks = list(dict.fromkeys(job.task for job in jobs))
    first = min(seed for job in jobs for seed in job.seeds)
    comparison = plan(limit, sum(len(job.seeds) for job in jobs), tasks=len(tasks))
    ours: list[Outcome] = []
    theirs: list[Outcome] = []
    done = 0
    decision: Decision | None = None
    for after in comparison.interim_analyses:
        block = jobs_for(jobs[0], tasks, after - done, first + done // len(tasks))
        theirs += baseline(block)
        ours += variant(block)
        done = after
        pairs = list(zip(theirs, ours, strict=True))
        lost = sum(one.success and not two.success for one, two in pairs)
        won = sum(two.success and not one.success for one, two in pairs)
        starts = [outcome.begins for outcome in theirs]
        decision = comparison.judge(lost, won, after, independent_starts(starts))
        if has_too_few_starts(starts) and decision.verdict in ("pass", "fail"):
            decision = replace(decision, verdict=GO_ON if after < comparison.most else "inconclusive")
        context.progress(f"{amount(after, 'pair')}: {describe_drop(decision)}", after / comparison.most)
        if decision.over:
            break
    if decision is None:
        raise ValueError("there are no episodes to play")
    return _in_order(theirs, tasks), _in_order(ours, tasks), decision


def _in_order(outcomes: list[Outcome], tasks: Sequence[str]) -> list[Outcome]:
    return sorted(outcomes, key=lambda outcome: (tasks.index(outcome.task), outcome.seed))


def describe_drop(decision: Decision) -> str:
    """Return the drop with its interval."""
    return f"the drop is {100 * decision.drop:.3g} points ({100 * decision.low:.3g} to {100 * decision.high:.3g})"


def with_decision(row: Row, decision: Decision) -> Row:
    """Return the row with the interval of its drop that holds over all interim analyses."""
    note = f"paired: {decision.lost} lost, {decision.won} won of {amount(decision.pairs, 'episode')}, "
    note += f"{decision.most} at most"
    note += f"; {distinct_starts(row.raw[series.START])} distinct starts"
    low, high = decision.low, decision.high
    drop = SUCCESS_DROP.measurement(decision.drop, samples=decision.pairs, low=low, high=high, note=note)
    return replace(row, measurements=tuple(drop if item.name == drop.name else item for item in row.measurements))


def sentence(decision: Decision, starts: int | None = None) -> str:
    """Return what was decided, after how many pairs, and of how many distinct ``starts`` (not told when None)."""
    allowed = f"{100 * decision.limit:.3g} points"
    what = {"pass": f"is at most {allowed}", "fail": f"is more than {allowed}"}.get(decision.verdict)
    seen = f"{decision.pairs} of at most {decision.most} paired episodes"
    seen += f" ({starts} distinct starts): " if starts is not None else ": "
    seen += describe_drop(decision)
    if what is None:
        return f"Whether the drop is more than {allowed} is not decided by {seen}."
    return f"The drop {what}, decided by {seen}, with an error of 2.5 % at most."
