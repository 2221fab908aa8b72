"""Text from elsewhere, such as names in a manifest or what a target says, as it may stand on a terminal."""

from __future__ import annotations

import errno
import re
import unicodedata

HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories that move the cursor, change colours or the order of letters, or cannot be encoded."""
KEPT = "\n\t\u200d\u00ad"
TOLD = 2000
"""Characters of what foreign code says that are shown."""


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


def shortened(text: str, longest: int = TOLD) -> str:
    """Return the beginning of a text that is too long, and how long it is; other texts as they are.

    Example:
        >>> shortened("x" * 5000, 3)
        'xxx... (5,000 characters)'
    """
    return text if len(text) <= longest else f"{text[:longest]}... ({len(text):,} characters)"


def without_password(text: str) -> str:
    """Return an address of a database, or an option with one, without its password; other texts as they are.

    Example:
        >>> without_password("--study=postgresql://me:secret@host/trials?sslpassword=other")
        '--study=postgresql://me:***@host/trials?sslpassword=***'
    """
    for secret in sorted(secrets_in(text), key=len, reverse=True):
        text = text.replace(secret, "***")
    return text


def secrets_in(text: str) -> set[str]:
    """Return what of an address is said to one reader alone: what is between the user and the last ``@``, and queries.

    An address may be malformed: what cannot be a port counts as a password.
    """
    found = re.match(r"(?:-+[\w-]+=)?[A-Za-z][\w+.-]*:(?://?)?(?P<rest>.*)", text, re.DOTALL)
    if found is None or ("://" not in text and "@" not in text):
        return set()
    rest, _, query = found["rest"].partition("?")
    if "@" in query:  # of a password with a question mark
        rest, query = found["rest"], ""
    before, at, _ = rest.rpartition("@")
    _, colon, password = (before if at else rest.partition("/")[0]).partition(":")
    secrets = {password} if colon and (at or not password.isdecimal()) else set()
    return {secret for secret in secrets | {item.partition("=")[2] for item in query.split("&")} if secret}


NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a place that takes no more."""


def file_of(error: OSError) -> str:
    """Return the file that an error of the operating system is about; nothing where it names none.

    A copy names two, first what is read, and it is the other one for which there is no room.
    """
    named = error.filename2 if error.errno in NO_ROOM and error.filename2 is not None else error.filename
    return "" if named is None else str(named)


def message_of(error: BaseException, longest: int = TOLD) -> str:
    """Return the text of an exception of somebody else's class, shortened; the class may fail to have one."""
    try:
        return shortened(str(error), longest).encode("utf-8", "replace").decode()
    except KeyboardInterrupt:
        raise
    except BaseException as another:  # the seam: it is code of the user
        return f"(its text cannot be told: {type(another).__name__})"


def _written(character: str) -> str:
    if character in KEPT or unicodedata.category(character) not in HIDDEN:
        return character
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")
