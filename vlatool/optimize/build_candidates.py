"""Stages of a plan, run one after the other: what they make is in the cache from then on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from vlatool.bundle.bundle import Bundle
from vlatool.errors import NOT_POSSIBLE, RecipeError
from vlatool.hardware.profile import Profile
from vlatool.optimize.plan import BASELINE, Plan, Transforms
from vlatool.report import Row
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.runtime.policy import refuse_findings
from vlatool.stage.base import Context
from vlatool.stage.run import cached_transform


@dataclass(frozen=True)
class Candidates:
    """What could be made, and what could not.

    Args:
        stages: name -> what was made on the way to each candidate, the candidate last; float32 first, alone.
        trained: names of those that were trained.
        failures: rows of those that could not be made, which say why.
    """

    stages: Mapping[str, tuple[Bundle, ...]]
    trained: tuple[str, ...]
    failures: tuple[Row, ...]

    @property
    def bundles(self) -> dict[str, Bundle]:
        """Name -> bundle, float32 first."""
        return {name: made[-1] for name, made in self.stages.items()}

    @property
    def engines(self) -> dict[str, str]:
        """Name -> engine of each candidate, without float32."""
        return {name: engine_of(bundle) for name, bundle in self.bundles.items() if name != BASELINE}


def engine_of(bundle: Bundle) -> str:
    """Return the engine that a bundle was made for."""
    return bundle.manifest.engine or DEFAULT_ENGINE


def chain(
    stages: Transforms, source: Bundle, board: Profile | None, accept: Iterable[str], cache: Path, context: Context
) -> tuple[Bundle, ...]:
    """Run stages one after the other; return the source and what each made.

    Args:
        accept: names of findings that are overruled.

    Raises:
        VlatoolError: what a stage raises; GraphError for a finding of the last bundle that is not accepted.
    """
    made = [source]
    for stage in stages:
        context.progress(stage.name(), None)
        stage.check(made[-1], board)
        made.append(cached_transform(stage, made[-1], cache, context).bundle)
    refuse_findings(made[-1], accept)
    return tuple(made)


def candidate(stages: Transforms, source: Bundle, baseline: Bundle, plan: Plan, context: Context) -> tuple[Bundle, ...]:
    """Make a candidate; return all that was made on the way, the candidate last.

    What changes the policy's modules starts at the source, and is exported after that; what does not starts at the
    float32 bundle.
    """
    changing = sum(stage.takes_modules for stage in stages)
    made: tuple[Bundle, ...] = (source,) if changing else (baseline,)
    exported = ((*stages[:changing], *plan.export),) if changing else ()
    accept = plan.recipe.limits.accept
    for part in (*exported, stages[changing:]):
        made = (*made[:-1], *chain(part, made[-1], plan.profile, accept, plan.cache, context))
    return made


def build(
    candidates: Mapping[str, Transforms], source: Bundle, baseline: Bundle, plan: Plan, context: Context
) -> Candidates:
    """Make every candidate; one that cannot be made becomes a row that says why.

    Raises:
        RecipeError: when none can be made; VlatoolError for what no other candidate could avoid.
    """
    made: dict[str, tuple[Bundle, ...]] = {BASELINE: (baseline,)}
    trained, failures = [], []
    for name, stages in candidates.items():
        try:
            made[name] = candidate(stages, source, baseline, plan, context)
        except NOT_POSSIBLE as error:
            failures.append(Row(name, "failed", error.message))
        else:
            trained += [name] if any(stage.trains for stage in stages) else []
    if len(made) == 1:
        raise RecipeError(
            "No candidate could be made: " + "; ".join(f"{row.name}: {row.reason}" for row in failures),
            "correct what they say, or name other candidates in a recipe: --recipe FILE",
        )
    return Candidates(made, tuple(trained), tuple(failures))
