"""Whether episodes of an evaluation are those of a training: the build record of a bundle says which those were."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.play import EVALUATION_SEEDS, EpisodesJob
from vlatool.errors import PluginError, RecipeError
from vlatool.stage.build import stage_class

FIX = f"leave --first-seed out: evaluations begin at {EVALUATION_SEEDS}, where no training reaches"


def seen_in_training(bundles: Sequence[Bundle], jobs: Sequence[EpisodesJob]) -> tuple[str, ...]:
    """Return a sentence for each training of a bundle that played some of the episodes."""
    seeds = {seed for job in jobs for seed in job.seeds}
    tasks = len({job.task for job in jobs})
    sentences = []
    for bundle in bundles:
        named = len(bundle.manifest.environment.get("tasks", ())) or tasks
        for stage, played in _played(bundle, named):
            if seen := seeds & set(played):
                which = f"{len(seen)} of the {len(seeds)} seeds from {min(seeds)} to {max(seeds)}"
                sentences.append(
                    f"{which} are of episodes that {stage} of {bundle.path} trained on ({played[0]} to {played[-1]})"
                )
    return tuple(dict.fromkeys(sentences))


def _played(bundle: Bundle, tasks: int) -> Iterator[tuple[str, range]]:
    """Yield each stage of the build record that trains in episodes, and the seeds of these for each task."""
    for entry in bundle.manifest.build or (bundle.manifest.made_by,):
        try:
            kind = stage_class(str(entry.get("stage", "")))
            seeds = getattr(kind.model_construct(**entry.get("options", {})), "seeds", None)
            if seeds is not None:
                yield str(entry["stage"]), seeds(tasks)
        except (RecipeError, PluginError, TypeError, ValueError, AttributeError):
            continue  # of another package, or no options of such a stage: nothing is known of it
