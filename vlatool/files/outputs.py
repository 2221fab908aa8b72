"""Checks on where output may be written: never over an input, or over something that vlatool did not write."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from vlatool.errors import OutputError
from vlatool.files.ownership import LEDGER, refuse_foreign
from vlatool.files.printable import file_of

RECIPE = "recipe.yaml"
MARKERS = (LEDGER, "manifest.json", "report.json")
"""Names of files that mark a directory as written by a program, into which no other file is written."""
BUNDLE, REPORT = "a bundle", "a report"
KINDS = {BUNDLE: ("manifest.json", "manifest.sha256"), REPORT: ("report.json",)}
"""Kind of a directory that vlatool wrote -> files that each of that kind has; the first match counts."""
SCRATCH = re.compile(r"vlatool-(?P<process>\d+)-\w{8}")
"""Name of a folder for temporary files."""
DISK_FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file would be larger than the limit on file sizes",
}
WRITE_ERRORS = {
    errno.EROFS: ("the file system is read-only", "write elsewhere"),
    errno.EACCES: ("permission denied", "write elsewhere, or change the permissions of the directory"),
    errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
    errno.EEXIST: ("a part of the path is a file", "choose another output"),
    errno.ENOTDIR: ("a part of the path is a file", "choose another output"),
    errno.EBUSY: ("it is in use as a file system", "choose another output"),
    errno.ENOENT: ("nothing can be made there, or it was removed meanwhile", "choose another output"),
}
"""Error of the operating system -> why nothing can be written there, and the fix."""
FREE_SPACE, RAISE_LIMIT = "free some space, or write elsewhere", "raise the limit (ulimit -f)"
OTHER_CACHE = "keep the cache elsewhere: VLATOOL_CACHE=DIR"
OTHER_SCRATCH = "free some space, or name another directory: TMPDIR=DIR"
EXISTS = "choose another output, or pass --force to replace it"


def kind_of(directory: Path) -> str:
    """Return the kind of a directory that vlatool wrote: ``BUNDLE``, ``REPORT``, or empty for all others."""
    fits = (kind for kind, names in KINDS.items() if all((directory / name).is_file() for name in names))
    return next(fits, "")


def refuse_replacing(
    final: Path, *, force: bool, protected: Mapping[str, Path] | None = None, kind: str | None = None
) -> None:
    """Refuse a path at which something exists that must not be replaced.

    Args:
        final: path at which a directory is to be written.
        force: whether a directory that vlatool wrote may be replaced.
        protected: description -> path of further directories that are never replaced.
        kind: kind of what is to be written, as ``kind_of`` returns it; None when not known yet.

    Raises:
        OutputError: naming what is in the way.
    """
    final = Path(os.path.abspath(final))
    if not os.path.lexists(final):
        return
    if final.is_symlink():
        raise OutputError(f"{final} is a link; nothing is replaced through it.", "choose another output")
    for name, path in {**_protected_directories(), **(protected or {})}.items():
        if Path(os.path.realpath(path)).is_relative_to(final.resolve()):
            raise OutputError(f"{final} is {name}, or holds it.", "name a directory for the output alone")
    if not force:
        raise OutputError(f"{final} exists already.", EXISTS)
    if not final.is_dir():
        raise OutputError(f"{final} is not a directory, so --force does not replace it.", "choose another output")
    if os.path.ismount(final):
        raise OutputError(f"{final} is a file system of its own.", "name a directory on it")
    existing = kind_of(final)
    if kind is not None and existing and existing != kind:
        instead = f", not {kind}" if kind else " and nothing of that is to be written"
        raise OutputError(f"{final}: it is {existing}{instead}.", "give another -o, or remove it yourself")
    refuse_foreign(final)


def _protected_directories() -> dict[str, Path]:
    """Return directories that are never replaced, nor is any directory that contains them."""
    directories = {}
    with contextlib.suppress(OSError):  # it may be gone
        directories["the current directory"] = Path.cwd()
    with contextlib.suppress(RuntimeError):
        directories["the home directory"] = Path.home()
    return directories


def refuse_inputs(final: Path, inputs: Iterable[str | os.PathLike[str] | None]) -> None:
    """Refuse an output that is an input of the command, contains one, or lies in one that vlatool wrote.

    Output inside the directory of a policy is allowed, and so is a recipe in the output as input: it was read before,
    and is written again.

    Args:
        inputs: what the command reads, as the user wrote it: files, directories, ``path.py:make``; None and names that
            are not files are ignored.

    Raises:
        OutputError: naming the input.
    """
    output = Path(os.path.realpath(final))
    for named in filter(None, map(str, (item for item in inputs if item is not None))):
        file = next((item for item in (named, named.rpartition(":")[0]) if item and os.path.exists(item)), None)
        if file is None:
            continue
        source = Path(os.path.realpath(file))
        if source.is_relative_to(output) and source != output / RECIPE:
            what = "is an input of this command" if source == output else f"holds {named}, an input of this command"
            raise OutputError(f"{final} {what}.", "name a directory for the output alone")
        if source.is_dir() and output.is_relative_to(source) and any((source / name).exists() for name in MARKERS):
            raise OutputError(f"{final} lies in {named}, an input of this command.", f"name a directory beside {named}")


@contextlib.contextmanager
def output_errors(final: Path, *, cache: bool = False) -> Iterator[None]:
    """Turn the operating system's errors of writing into an error of one sentence that names the output.

    Args:
        cache: whether it lies in vlatool's cache, so that another output would not help.

    Raises:
        OutputError: for a full disk, unless the error names a file elsewhere, and for what is wrong with this place.
    """
    try:
        yield
    except OSError as error:
        number = error.errno or 0
        reason, remedy = (DISK_FULL[number], FREE_SPACE) if number in DISK_FULL else WRITE_ERRORS.get(number, ("", ""))
        mentioned = Path(os.path.abspath(file_of(error) or "-"))
        drafts = any(part.startswith(f".{final.name}.") for part in mentioned.parts)
        ours = drafts or mentioned.is_relative_to(final) or final.is_relative_to(mentioned)
        lost = number == errno.ENOENT and not final.is_relative_to(mentioned) and _draft_of(mentioned, final).exists()
        if not reason or lost or not (ours or (number in DISK_FULL and not file_of(error))):
            raise
        what = ""
        if in_scratch(final):
            what, remedy = "temporary files: ", OTHER_SCRATCH
        elif cache:
            free = "free some space there (vlatool cache prune), or "
            what, remedy = "to the cache: ", f"{free if number in DISK_FULL else ''}{OTHER_CACHE}"
        remedy = RAISE_LIMIT if number == errno.EFBIG else remedy
        raise OutputError(f"Cannot write {what}{final}: {reason}.", remedy) from error


def _draft_of(named: Path, final: Path) -> Path:
    """Return the draft of an output that contains a path; the path itself where there is none."""
    drafts = (path for path in (named, *named.parents) if path.name.startswith(f".{final.name}."))
    return next(drafts, named)


def in_scratch(path: Path) -> bool:
    """Return whether a path is a scratch directory of ``vlatool.files.scratch``, or lies in one."""
    home = Path(tempfile.gettempdir())
    return any(part.parent == home and SCRATCH.fullmatch(part.name) for part in (path, *path.parents))
