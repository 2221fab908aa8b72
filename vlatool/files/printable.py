"""Text from elsewhere, such as names in a manifest or what a target says, as it may stand on a terminal."""

from __future__ import annotations

import re
import unicodedata

HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories that move the cursor, change colours or the order of letters, or cannot be encoded."""
KEPT = "\n\t\u200d\u00ad"


def printable(text: str) -> str:
    r"""Return a text in which control characters are written out.

    Example:
        >>> printable("a\x1b[2Jb")
        'a\\x1b[2Jb'
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_written(character) for character in text)


def one_line(text: str, longest: int = 400) -> str:
    """Return a text as one printable line of a bounded length."""
    return " ".join(printable(text[: 4 * longest]).split())[:longest]


def without_password(text: str) -> str:
    """Return a text in which no address of a database tells its password.

    Example:
        >>> without_password("--study=postgresql://me:secret@host/trials")
        '--study=postgresql://me:***@host/trials'
    """
    return re.sub(r"(\w://[^/@:\s]*):[^/\s]*@", r"\1:***@", text)


def message_of(error: BaseException) -> str:
    """Return the text of an exception of somebody else's class, which may fail to have one."""
    try:
        return str(error).encode("utf-8", "replace").decode()
    except KeyboardInterrupt:
        raise
    except BaseException as another:  # the seam: it is code of the user
        return f"(its text cannot be told: {type(another).__name__})"


def _written(character: str) -> str:
    if character in KEPT or unicodedata.category(character) not in HIDDEN:
        return character
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")
