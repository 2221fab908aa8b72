"""Everything that ``optimize`` will do, checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from vlatool.errors import RecipeError, require_present
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.files.printable import mask_passwords
from vlatool.hardware.profile import Profile
from vlatool.machine.host import fingerprint, matches
from vlatool.machine.instruction_sets import BoardSet, board_set
from vlatool.module.source import OWN_RECORDINGS, RecordingOptions
from vlatool.optimize.recipe import Limits, Pruning, Recipe, StageList, stage_entries
from vlatool.optimize.study_storage import check_storage
from vlatool.sources import Source, source_stage
from vlatool.stage.base import Stage, Transform
from vlatool.stage.build import build_stage
from vlatool.stage.chain import steps_of

BASELINE = "float32"
Transforms = tuple[Transform, ...]


@dataclass(frozen=True)
class Plan:
    """Stages, candidates and limits of one run.

    Args:
        export: Stages from the policy to the float32 bundle; none where the source has graphs.
        candidates: Name -> stages from there, or from the policy for those that change its modules.
        profile: The board; None for this host.
        fresh: Measure again, even what was measured before.
        typed: The source as the user named it.
        recordings: Recordings that the user named.
    """

    source: Source
    export: Transforms
    candidates: Mapping[str, Transforms]
    recipe: Recipe
    profile: Profile | None
    cache: Path
    fresh: bool = False
    typed: str = ""
    recordings: RecordingOptions = OWN_RECORDINGS

    @property
    def board_set(self) -> BoardSet:
        """What OpenVINO computes in on the board, beside what it computes in here."""
        return board_set(self.profile)

    @property
    def board(self) -> str:
        """Name of the profile, or of what stands in for it."""
        return self.profile.name if self.profile else "this host"

    @property
    def on_board(self) -> bool:
        """Whether this host is the board, so that what is measured here holds there."""
        return self.profile is None or matches(self.profile.model_strings, fingerprint())

    @property
    def closed_loop(self) -> ClosedLoop | None:
        """The closed-loop evaluation, None when the policy names no environment or no episodes are wanted."""
        described = self.source.describe() if self.recipe.effort.episodes else None
        if described is None or not described.environment:
            return None
        effort = self.recipe.effort
        return ClosedLoop(
            policy=self.source.policy, episodes=effort.episodes, environment_timeout=effort.environment_timeout
        )

    def lines(self) -> Iterator[str]:
        """Describe the plan, a line for each stage."""
        yield f"source      {self.source.name()} {self.source.policy or ''}".rstrip()
        for stage in self.export:
            yield f"export      {stage.name()} {_options(stage)}".rstrip()
        for name, stages in self.candidates.items():
            yield f"candidate   {name}: " + ", ".join(f"{stage.name()} {_options(stage)}".rstrip() for stage in stages)
        effort = self.recipe.effort
        yield f"benchmark   {effort.iterations} inferences of each, interleaved, {effort.threads} thread(s), this host"
        loop = self.closed_loop
        yield "evaluate    recorded observations" + (f", {loop.episodes} paired closed-loop episodes" if loop else "")
        limits = self.recipe.limits
        if self.recipe.search:
            yield "search      engines, methods, mixed-precision plans; the fastest inside the budget become candidates"
        if (pruning := self.recipe.pruning).trials:
            yield f"trials      {_trials(pruning)}"
        yield f"limits      {', '.join(_limits(limits))}"
        origin = "predicted, unless this host is that board" if self.profile else "measured"
        yield f"profile     {self.board} ({origin})"
        if computed := self.board_set.plan():
            yield f"computes    {computed}"
        yield f"cache       {self.cache}"


def make_plan(
    source: str,
    profile: Profile | None,
    recipe: Recipe,
    cache: Path,
    recordings: RecordingOptions = OWN_RECORDINGS,
    *,
    fresh: bool = False,
) -> Plan:
    """Build and check every stage; nothing has run when this returns.

    Args:
        recordings: recordings in the place of those that the policy names.

    Raises:
        VlatoolError: for the first thing that cannot work.
    """
    stage = source_stage(source).with_recordings(recordings)
    stage.check(None, profile)
    export = () if stage.has_graphs else transforms(recipe.export)
    candidates = {name: transforms(stages) for name, stages in recipe.candidates.items()}
    for name, stages in candidates.items():
        changing = [stage.takes_modules for stage in stages]
        if changing != sorted(changing, reverse=True) or any(stage.kind() == "export" for stage in stages):
            raise RecipeError(
                f"The candidate '{name}' changes modules after a graph was made, or exports.",
                "put the stages of prune and distill first, and options of the export under 'export'",
            )
        if name == BASELINE or not name.replace("_", "").replace("-", "").isalnum():
            raise RecipeError(
                f"A candidate cannot be called '{name}'; use letters, digits, '-' and '_'.", "rename it in the recipe"
            )
    if recipe.pruning.trials:
        _check_pruning(recipe.pruning, stage)
        if recipe.pruning.study:
            check_storage(recipe.pruning.study)
    elif study := recipe.pruning.study:
        raise RecipeError(f"The study {mask_passwords(study)} keeps trials; none are asked for.", "add --trials 8")
    plan = Plan(stage, export, candidates, recipe, profile, cache, fresh, source, recordings)
    asked = {"--max-motion": recipe.limits.max_motion, "--worst-task": recipe.limits.worst_task}
    if plan.closed_loop is None and (named := [name for name, limit in asked.items() if limit is not None]):
        raise RecipeError(
            f"{' and '.join(named)} {'is' if len(named) == 1 else 'are'} of closed-loop episodes, and none are played.",
            "name an environment in policy.yaml (docs/guides/environment.md), and ask for --episodes",
        )
    return plan


def _check_pruning(pruning: Pruning, source: Source) -> None:
    """Refuse trials that could not be made.

    Raises:
        RecipeError: when the source has no modules, or something else than a training is to recover them.
        MissingExtra: without Optuna.
    """
    if source.has_graphs:
        raise RecipeError("What is exported has no modules that could be pruned.", "name the policy, or drop --trials")
    stages = transforms(pruning.recover)
    if not any(stage.trains for stage in stages) or not all(
        stage.kind() in ("distill", "quantize") for stage in stages
    ):
        raise RecipeError(
            "Under pruning, 'recover' names what trains a pruned policy; got "
            f"{', '.join(stage.name() for stage in stages) or 'nothing'}.",
            "name distill.policy, with its options",
        )
    require_present("optuna", "search")


def transforms(stages: StageList) -> Transforms:
    """Return the stages of a list of entries, each as the steps that it stands for.

    Raises:
        RecipeError: when one reads a policy or measures; UsageError when there is no such stage or option.
    """
    built: list[Transform] = []
    for name, options in stage_entries(stages):
        stage = build_stage(name, options or {})
        if stage.kind() == "sources":
            raise RecipeError(
                f"The stage {name} reads a policy; the policy is named on the command line.",
                "leave the stage out of the recipe",
            )
        if not isinstance(stage, Transform):
            raise RecipeError(
                f"The stage {name} measures; a recipe lists stages that make a bundle.",
                "leave the stage out of the recipe: optimize measures by itself",
            )
        built += steps_of(stage)
    return tuple(built)


def _limits(limits: Limits) -> list[str]:
    """Return the limits in words."""
    drop = f"drop <= {100 * limits.max_drop:g} points"
    words = [f"{limits.metric} <= {limits.max_metric:g}" if limits.metric else drop]
    words += [f"{limits.hz:g} Hz"] if limits.hz else []
    words += [f"latency <= {limits.max_latency_ms:g} ms"] if limits.max_latency_ms else []
    words += [f"memory <= {limits.max_memory_mb:g} MB"] if limits.max_memory_mb else []
    words += [] if limits.max_motion is None else [f"jerk, path and task time <= {1 + limits.max_motion:g}x"]
    words += [] if limits.worst_task is None else [f"drop of the worst task <= {100 * limits.worst_task:g} points"]
    return words + ([] if limits.metric else [f"distance from float32 <= {100 * limits.max_distance:g} %"])


def _trials(pruning: Pruning) -> str:
    """Return the trials in words."""
    trained = ", ".join(f"{stage.name()} {_options(stage)}".rstrip() for stage in transforms(pruning.recover))
    study = f", shared through {mask_passwords(pruning.study)}" if pruning.study else ""
    return f"{pruning.trials} policies, pruned, trained ({trained}), quantized and tried{study}"


def _options(stage: Stage) -> str:
    return " ".join(f"{key}={value}" for key, value in stage.options().items())
