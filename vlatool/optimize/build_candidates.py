"""Stages of a plan, run one after the other: what they make is in the cache from then on."""

from __future__ import annotations

from vlatool.bundle.bundle import Bundle
from vlatool.optimize.plan import Plan
from vlatool.runtime.policy import refuse_findings
from vlatool.stage.base import Context, Transform
from vlatool.stage.run import cached_transform


def chain(stages: tuple[Transform, ...], source: Bundle, plan: Plan, context: Context) -> list[Bundle]:
    """Run stages one after the other; return the source and what each made.

    Raises:
        VlatoolError: what a stage raises; GraphError for a finding of the last bundle that is not accepted.
    """
    made = [source]
    for stage in stages:
        context.progress(stage.name(), None)
        stage.check(made[-1], plan.profile)
        made.append(cached_transform(stage, made[-1], plan.cache, context).bundle)
    refuse_findings(made[-1], plan.recipe.limits.accept)
    return made


def candidate(
    stages: tuple[Transform, ...], source: Bundle, baseline: Bundle, plan: Plan, context: Context
) -> list[Bundle]:
    """Make a candidate; return all that was made on the way, the candidate last.

    What changes the policy's modules starts at the source, and is exported after that; what does not starts at the
    float32 bundle.
    """
    changed = stages[: sum(stage.takes_modules for stage in stages)]
    started = chain((*changed, *plan.export), source, plan, context) if changed else [baseline]
    return [*started, *chain(stages[len(changed) :], started[-1], plan, context)[1:]]
