"""Where nothing may be written: over what somebody needs, or did not get from vlatool."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from vlatool.errors import OutputError
from vlatool.files.printable import file_of
from vlatool.files.written import LEDGER, refuse_foreign

RECIPE = "recipe.yaml"
WRITTEN = (LEDGER, "manifest.json", "report.json")
"""Names that tell of a directory which a program wrote: another file in it would make it another one."""
BUNDLE, REPORT = "a bundle", "a report"
KINDS = {BUNDLE: ("manifest.json", "manifest.sha256"), REPORT: ("report.json",)}
"""What a directory that vlatool wrote is -> the files that all of its kind hold; the first that fits it is."""
SCRATCH = re.compile(r"vlatool-(?P<process>\d+)-\w{8}")
"""What a folder for temporary files is called."""
FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file would be larger than the limit on file sizes",
}
REFUSED = {
    errno.EROFS: ("the file system is read-only", "write elsewhere"),
    errno.EACCES: ("permission denied", "write elsewhere, or change the permissions of the directory"),
    errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
    errno.EEXIST: ("a part of the path is a file", "choose another output"),
    errno.ENOTDIR: ("a part of the path is a file", "choose another output"),
    errno.EBUSY: ("it is in use as a file system", "choose another output"),
    errno.ENOENT: ("nothing can be made there, or it was removed meanwhile", "choose another output"),
}
"""What the operating system says of a place -> why nothing is written there, and what to do about an output."""
FREE, LARGER = "free some space, or write elsewhere", "raise the limit (ulimit -f)"
OTHER_CACHE = "keep the cache elsewhere: VLATOOL_CACHE=DIR"
OTHER_SCRATCH = "free some space, or name another directory: TMPDIR=DIR"
EXISTS = "choose another output, or pass --force to replace it"


def kind_of(directory: Path) -> str:
    """Return what a directory that vlatool wrote is: ``BUNDLE``, ``REPORT``, or nothing for all others."""
    fits = (kind for kind, names in KINDS.items() if all((directory / name).is_file() for name in names))
    return next(fits, "")


def refuse_replacing(
    final: Path, *, force: bool, further: Mapping[str, Path] | None = None, kind: str | None = None
) -> None:
    """Refuse a place where something is that may not be replaced.

    Args:
        final: Where a directory is to be written.
        force: Whether a directory that vlatool wrote may be replaced.
        further: Directories that are never replaced, beside the current and the home directory, by what they are.
        kind: What is to be written, as ``kind_of`` says it; None where that is not known yet.

    Raises:
        OutputError: naming what is in the way.
    """
    final = Path(os.path.abspath(final))
    if not os.path.lexists(final):
        return
    if final.is_symlink():
        raise OutputError(f"{final} is a link; nothing is replaced through it.", "choose another output")
    for name, place in {**_dear(), **(further or {})}.items():
        if Path(os.path.realpath(place)).is_relative_to(final.resolve()):
            raise OutputError(f"{final} is {name}, or holds it.", "name a directory for the output alone")
    if not force:
        raise OutputError(f"{final} exists already.", EXISTS)
    if not final.is_dir():
        raise OutputError(f"{final} is not a directory, so --force does not replace it.", "choose another output")
    if os.path.ismount(final):
        raise OutputError(f"{final} is a file system of its own.", "name a directory on it")
    there = kind_of(final)
    if kind is not None and there and there != kind:
        instead = f", not {kind}" if kind else " and nothing of that is to be written"
        raise OutputError(f"{final}: it is {there}{instead}.", "give another -o, or remove it yourself")
    refuse_foreign(final)


def _dear() -> dict[str, Path]:
    """Return directories that are never replaced, and neither is what holds them."""
    places = {}
    with contextlib.suppress(OSError):  # it may be gone
        places["the current directory"] = Path.cwd()
    with contextlib.suppress(RuntimeError):
        places["the home directory"] = Path.home()
    return places


def refuse_inputs(final: Path, inputs: Iterable[str | os.PathLike[str] | None]) -> None:
    """Refuse an output that is an input of the command, holds one, or lies in one that vlatool wrote.

    A place in the directory of a policy may be written to, and the recipe that an output holds may be its input: it was
    read before, and is written again.

    Args:
        final: Where something is to be written.
        inputs: What the command reads, as a person names it: files, directories, ``path.py:make``; None and names of
            things that are no files are passed over.

    Raises:
        OutputError: naming the input.
    """
    place = Path(os.path.realpath(final))
    for named in filter(None, map(str, (item for item in inputs if item is not None))):
        file = next((item for item in (named, named.rpartition(":")[0]) if item and os.path.exists(item)), None)
        if file is None:
            continue
        source = Path(os.path.realpath(file))
        if source.is_relative_to(place) and source != place / RECIPE:
            what = "is an input of this command" if source == place else f"holds {named}, an input of this command"
            raise OutputError(f"{final} {what}.", "name a directory for the output alone")
        if source.is_dir() and place.is_relative_to(source) and any((source / name).exists() for name in WRITTEN):
            raise OutputError(f"{final} lies in {named}, an input of this command.", f"name a directory beside {named}")


@contextlib.contextmanager
def output_errors(final: Path, *, cache: bool = False) -> Iterator[None]:
    """Map the operating system's refusals to write into one sentence for the person, which names the place.

    Args:
        final: What is written.
        cache: Whether it lies in vlatool's cache, so that another output would not help.

    Raises:
        OutputError: for a full disk, unless the error names a file elsewhere, and for what is wrong with this place.
    """
    try:
        yield
    except OSError as error:
        number = error.errno or 0
        reason, remedy = (FULL[number], FREE) if number in FULL else REFUSED.get(number, ("", ""))
        named = Path(os.path.abspath(file_of(error) or "-"))
        drafts = any(part.startswith(f".{final.name}.") for part in named.parts)
        ours = drafts or named.is_relative_to(final) or final.is_relative_to(named)
        lost = number == errno.ENOENT and not final.is_relative_to(named) and _draft_of(named, final).exists()
        if not reason or lost or not (ours or (number in FULL and not file_of(error))):
            raise
        what = ""
        if in_scratch(final):
            what, remedy = "temporary files: ", OTHER_SCRATCH
        elif cache:
            free = "free some space there (vlatool cache prune), or "
            what, remedy = "to the cache: ", f"{free if number in FULL else ''}{OTHER_CACHE}"
        remedy = LARGER if number == errno.EFBIG else remedy
        raise OutputError(f"Cannot write {what}{final}: {reason}.", remedy) from error


def _draft_of(named: Path, final: Path) -> Path:
    """Return the draft of an output in which a path lies; the path itself where it lies in none."""
    drafts = (place for place in (named, *named.parents) if place.name.startswith(f".{final.name}."))
    return next(drafts, named)


def in_scratch(path: Path) -> bool:
    """Say whether a path is one of the temporary files of ``vlatool.files.scratch``, or lies in their folder."""
    home = Path(tempfile.gettempdir())
    return any(place.parent == home and SCRATCH.fullmatch(place.name) for place in (path, *path.parents))
