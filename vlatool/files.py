"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a draft beside ``path``: it takes the place of ``path`` when the block ends, and is removed when it fails.

    A symbolic link stays one: the file that it leads to is written.

    Raises:
        OSError: when the draft cannot be moved.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with whole_file(target) as draft:
        ...     _ = draft.write_text("all of it")
        >>> target.read_text()
        'all of it'
    """
    target = path.resolve()
    draft = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        yield draft
        draft.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to tell
            draft.unlink(missing_ok=True)
        raise
