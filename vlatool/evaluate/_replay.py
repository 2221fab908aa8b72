"""The episode that is worth a look, played again: for the drawing in a report, and for a video."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vlatool.accuracy.episode_choice import differs_most, stands_out
from vlatool.accuracy.success_comparison import Outcome
from vlatool.bundle.bundle import Bundle
from vlatool.episodes.film import Film
from vlatool.episodes.filmable import check_filmable
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, OutputError, SourceError, VlatoolError
from vlatool.evaluate._names import names_of
from vlatool.files.printable import message_of
from vlatool.files.scratch import scratch_directory
from vlatool.render.filmstrip import Shot, filmstrip
from vlatool.render.video import write_video
from vlatool.stage.base import Context

Play = Callable[[list[EpisodesJob]], list[Outcome]]
SCRATCH = 1 << 26
"""Bytes that must be free for pictures on their way to a video."""


@dataclass(frozen=True)
class Again:
    """What came of playing an episode again.

    Args:
        outcomes: outcomes with their steps, the baseline's first; empty where it was not played, or no report shows it.
    """

    outcomes: tuple[Outcome, ...] = ()
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def check_video_of(bundles: Sequence[Bundle], job: EpisodesJob, context: Context) -> None:
    """Refuse, before episodes are played, a video that cannot be made; nothing where none is asked for.

    Raises:
        DataError: when there is no picture of an episode.
        OutputError: when the disk has no room for pictures on their way to it.
        SourceError: when the environment ends the process that it runs in.
    """
    if not context.video:
        return
    folder = tempfile.gettempdir()
    if shutil.disk_usage(folder).free < SCRATCH:
        raise OutputError(f"A video needs some room in {folder}, and the disk is full.", "free some, or set TMPDIR")
    check_filmable(bundles, job, context)


def played_again(
    job: EpisodesJob,
    played: Sequence[list[Outcome]],
    plays: Sequence[Play],
    bundles: Sequence[Bundle],
    context: Context,
) -> Again:
    """Play one episode again with each variant: that in which both differ most; of one alone, that which stands out.

    All that is measured was measured before, so that nothing here fails: what cannot be shown is left out.

    Args:
        played: Outcomes of all episodes, the baseline's first, when there is one.
        context: Says where the video is to be written.
    """
    paired = len(played) > 1
    if not paired and not context.video:
        return Again()
    index, why = _place(played)
    before = [outcomes[index] for outcomes in played]
    again = replace(job, task=before[-1].task, seeds=(before[-1].seed,), show=True)
    warnings = []
    if context.video:
        name = Path(context.video).name
        try:
            found, sentence = _filmed(again, before, plays, bundles, context)
            return Again(tuple(found) if paired else (), (f"{name} shows {why}: {sentence}.",))
        except Exception as error:  # a picture is not worth the measurement
            warnings = [f"{name} was not written: {_reason(error)}"]
    outcomes = _drawn(again, plays) if paired else ()
    warnings += _unrepeatable(before, outcomes, names_of(bundles))
    return Again(outcomes, warnings=tuple(warnings))


def _unrepeatable(before: Sequence[Outcome], outcomes: Sequence[Outcome], names: Sequence[str]) -> Iterator[str]:
    """Yield a warning where an episode went another way than before: its seed does not decide it."""
    other = [name for name, one, two in zip(names, before, outcomes, strict=False)
             if (one.success, one.steps, one.motion) != (two.success, two.steps, two.motion)]  # fmt: skip
    if other:
        where = f"task '{before[-1].task}' at seed {before[-1].seed}"
        yield (
            f"{where}, played again with {' and '.join(other)}, went another way: the environment gives other episodes "
            "for the same seed, so that pairs differ by chance; let reset(seed=...) decide all that it draws"
        )


def _place(played: Sequence[list[Outcome]]) -> tuple[int, str]:
    if len(played) > 1:
        return differs_most(played[0], played[-1]), "the episode in which the variants differ most"
    index = stands_out(played[0])
    return index, "the longest episode" if played[0][index].success else "the first episode that fails"


def _drawn(again: EpisodesJob, plays: Sequence[Play]) -> tuple[Outcome, ...]:
    try:
        return tuple(play([again])[0] for play in plays)
    except (DataError, SourceError):
        return ()


def _filmed(
    again: EpisodesJob, before: Sequence[Outcome], plays: Sequence[Play], bundles: Sequence[Bundle], context: Context
) -> tuple[list[Outcome], str]:
    """Play the episode, film it and write the video; return its outcomes, and what is to be seen."""
    context.progress("filming an episode", None)
    with scratch_directory() as scratch:
        folders = [scratch / str(index) for index in range(len(plays))]
        found = [play([replace(again, film=str(folder))])[0] for play, folder in zip(plays, folders, strict=True)]
        names = names_of(bundles)
        shots = [_shot(name, outcome, Film.open(folder))
                 for name, outcome, folder in zip(names, found, folders, strict=True)]  # fmt: skip
        episode = f"task '{again.task}', seed {again.seeds[0]}"
        asked = f": {found[-1].instruction}" if found[-1].instruction else ""
        video = filmstrip(shots, f"{episode}{asked}", bundles[-1].manifest.spec.rate)
        lacks = write_video(video, Path(context.video), force=context.force)
    return found, "; ".join([episode, *_reservations(shots, before), *([lacks] if lacks else [])])


def _shot(name: str, outcome: Outcome, film: Film) -> Shot:
    fresh = [step for step, begins in enumerate(outcome.series.get("fresh", ()), 1) if begins and step > 1]
    seams = tuple(fresh) if len(fresh) < outcome.steps - 1 else ()
    return Shot(name, film, film.count, film.size, outcome.steps, outcome.success, seams)


def _reservations(shots: Sequence[Shot], before: Sequence[Outcome]) -> Iterator[str]:
    """Yield what a video does not show, and where the episode went another way than when it was measured."""
    for shot, outcome in zip(shots, before, strict=True):
        if shot.count <= shot.steps:
            yield f"of {shot.variant} the first {shot.count - 1:,} of {shot.steps:,} steps"
        if (shot.success, shot.steps) != (outcome.success, outcome.steps):
            ended = f"{'success' if outcome.success else 'failure'} at step {outcome.steps:,}"
            yield f"played again, {shot.variant} went another way than when it was measured ({ended})"


def _reason(error: Exception) -> str:
    """Return why there is no video, as a part of a sentence."""
    if isinstance(error, VlatoolError):
        return f"{error.message}{f' ({error.fix})' if error.fix else ''}"
    return f"{type(error).__name__}: {message_of(error)}."
