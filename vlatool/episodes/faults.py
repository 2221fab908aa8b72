"""Where in the episodes a fault is: every error of an environment names its task, its seed and what to do."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from vlatool.episodes.disturbances import BUILT_IN_DISTURBANCES
from vlatool.errors import DataError, SourceError, VlatoolError
from vlatool.files.printable import message_of
from vlatool.module.factory import CORRECT_CODE, map_user_exceptions


def under_way(task: str, seed: int) -> str:
    """Return what a child says when it begins an episode, so that its parent knows where it ended."""
    return f"task '{task}', seed {seed}"


@contextlib.contextmanager
def error_context(task: str, seed: int | None = None, under: tuple[str, float] | None = None) -> Iterator[None]:
    """Turn whatever is raised in this block into an error that names task, seed and remedy.

    Args:
        seed: seed of the episode; None before there is one.
        under: Disturbance and strength; None where there is none.

    Raises:
        VlatoolError: of the class that was raised.
        DataError: for every other exception.
        SourceError: for what is raised beside ``Exception``.
    """
    at = "" if seed is None else f" at seed {seed}{_under(under)}"
    try:
        with map_user_exceptions(f"the environment of task '{task}'{at and f',{at},'}"):
            yield
    except VlatoolError as error:
        locate(error, task, seed, under=under)
        raise
    except Exception as error:  # the seam: a user's environment may raise anything
        said = f"The environment of task '{task}' failed{at}: {type(error).__name__}: {message_of(error)}."
        raise DataError(said, _remedy(task, seed, under)) from error


def locate(
    error: VlatoolError, task: str, seed: int | None, seeds: str = "", under: tuple[str, float] | None = None
) -> None:
    """Add to an error what of task and seed it does not name, and what to do where it does not say it.

    Args:
        seed: seed of the episode; None where it is not known.
        seeds: Which ones come into question then, a part of a sentence.
        under: Disturbance and strength; None where there is none.
    """
    message = str(error.message)
    words = [] if "task '" in message else [f"in task '{task}'"]
    if seed is not None and " seed " not in message:
        words.append(f"at seed {seed}")
    elif seed is None and seeds:
        words.append(seeds)
    if under and f"under {under[0]}" not in message.replace("Under", "under"):
        words.append(_under(under).strip())
    if words:
        start = " ".join(words)
        error.message = f"{start[:1].upper()}{start[1:]}: {message}"
    if error.fix in ("", CORRECT_CODE) and isinstance(error, DataError | SourceError):
        error.fix = _remedy(task, seed, under)


def _under(under: tuple[str, float] | None) -> str:
    return f" under {under[0]}, strength {under[1]:g}" if under else ""


def _remedy(task: str, seed: int | None, under: tuple[str, float] | None = None) -> str:
    call = f"make(task={task!r})" + ("" if seed is None else f".reset(seed={seed})")
    if under and under[0] not in BUILT_IN_DISTURBANCES and seed is not None:
        call = f"e = make(task={task!r}), then e.disturb({under[0]!r}, {under[1]:g}, {seed}) and e.reset(seed={seed})"
    return f"call {call} of the environment yourself, and correct what fails; VLATOOL_DEBUG=1 shows where it was raised"
