"""Untrusted text, such as names in a manifest or output of a target, made safe for a terminal."""

from __future__ import annotations

import errno
import re
import unicodedata

HIDDEN_CATEGORIES = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories that move the cursor, change colours or the order of letters, or cannot be encoded."""
ALLOWED_CHARACTERS = "\n\t\u200d\u00ad"
MAX_CHARACTERS = 2000
"""Characters of a foreign message that are shown."""


def printable(text: str) -> str:
    r"""Return a text in which control characters are escaped.

    Example:
        >>> printable("a\x1b[2Jb")
        'a\\x1b[2Jb'
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escape(character) for character in text)


def one_line(text: str, longest: int = 400) -> str:
    """Return a text as one printable line of a bounded length."""
    return " ".join(printable(text[: 4 * longest]).split())[:longest]


def truncate(text: str, longest: int = MAX_CHARACTERS) -> str:
    """Return a text as it is, or the beginning of one that is too long, with its length.

    Example:
        >>> truncate("x" * 5000, 3)
        'xxx... (5,000 characters)'
    """
    return text if len(text) <= longest else f"{text[:longest]}... ({len(text):,} characters)"


def amount(number: int, noun: str) -> str:
    """Return a number and what it is of, in the singular for 1.

    Example:
        >>> amount(1, "step"), amount(0, "entry"), amount(2, "process")
        ('1 step', '0 entries', '2 processes')
    """
    if number == 1:
        return f"{number} {noun}"
    if noun.endswith("y"):
        return f"{number} {noun[:-1]}ies"
    return f"{number} {noun}{'es' if noun.endswith('s') else 's'}"


def reason_of(message: str) -> str:
    """Return what a check said, without the kind of error that pydantic and typer put before it.

    Example:
        >>> reason_of("Value error, 'nope' is not one of 'auto', 'trace'.")
        "'nope' is not one of 'auto', 'trace'."
    """
    return re.sub(r"^(Value error|Assertion failed), ", "", message)


def mask_passwords(text: str) -> str:
    """Return the address of a database, or an option with one, with its passwords masked; other texts as they are.

    Example:
        >>> mask_passwords("--study=postgresql://me:secret@host/trials?sslpassword=other")
        '--study=postgresql://me:***@host/trials?sslpassword=***'
    """
    for secret in sorted(secrets_in(text), key=len, reverse=True):
        text = text.replace(secret, "***")
    return text


def secrets_in(text: str) -> set[str]:
    """Return the secrets in an address: what is between the user and the last ``@``, and the values of its query.

    The address may be malformed: what cannot be a port counts as a password.
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
"""Errors of a disk without space."""


def file_of(error: OSError) -> str:
    """Return the file that an error of the operating system names, else nothing.

    A copy names two, the source first; where space is lacking, the second one matters.
    """
    named = error.filename2 if error.errno in NO_ROOM and error.filename2 is not None else error.filename
    return "" if named is None else str(named)


def message_of(error: BaseException, longest: int = MAX_CHARACTERS) -> str:
    """Return the text of an exception of a foreign class, truncated; its ``__str__`` may fail."""
    try:
        return truncate(str(error), longest).encode("utf-8", "replace").decode()
    except KeyboardInterrupt:
        raise
    except BaseException as another:  # the seam: it is code of the user
        return f"(its text cannot be read: {type(another).__name__})"


def _escape(character: str) -> str:
    if character in ALLOWED_CHARACTERS or unicodedata.category(character) not in HIDDEN_CATEGORIES:
        return character
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")
