"""What a file that torch wrote holds, found without opening it: neither pickle nor code of it runs."""

from __future__ import annotations

import io
import pickletools
import zipfile
from enum import Enum
from pathlib import Path

from vlatool.errors import SourceError
from vlatool.files.limits import limit
from vlatool.files.printable import one_line

OWN_MODULES = ("torch", "collections", "numpy")
"""First parts of the names that a pickle of tensors alone refers to."""
PLAIN_TYPES = ("set", "frozenset", "dict", "list", "tuple", "int", "float", "bool", "str", "bytes", "slice", "range")
"""Names of Python's own that it may refer to as well."""
MAX_PICKLE_BYTES = 64 << 20
MAX_GROWTH = 4
"""How many times its own size an archive may unpack to: torch stores without compression, apart from texts of code."""
MODULE_AGAIN = (
    "build the module in a few lines of Python, load the weights there, and name that: a policy.yaml with "
    "source: policy.py:make (docs/guides/your-own-policy.md), or save it with torch.jit.save or torch.export.save"
)
TEXT_OPERATIONS = ("SHORT_BINUNICODE", "BINUNICODE", "UNICODE", "BINUNICODE8", "STRING")


class Kind(Enum):
    """What an archive is."""

    SCRIPT = "TorchScript"
    PROGRAM = "a program of torch.export"
    COMPILED = "a program that AOTInductor compiled for one machine"
    PICKLE = "a pickle of Python objects"


def kind_of(path: Path) -> Kind:
    """Return what a file is that torch wrote.

    Raises:
        SourceError: when it is none, damaged, or unpacks to more than it should.
    """
    if not path.is_file():
        raise SourceError(f"No such file: {path}.", "check the path")
    names = _names(path)
    if names is None:
        return Kind.PICKLE
    inner = {name.partition("/")[2] for name in names}
    if any(name.startswith("data/aotinductor/") for name in inner):
        return Kind.COMPILED
    if any(name.startswith("models/") for name in inner) or "serialized_exported_program.json" in names:
        return Kind.PROGRAM
    if "constants.pkl" in inner and any(name.startswith("code/") for name in inner):
        return Kind.SCRIPT
    if "data.pkl" in inner:
        return Kind.PICKLE
    raise SourceError(
        f"{path} is a zip file that torch did not write: it holds {_listed(names)}.",
        "name the policy itself: what torch.jit.save or torch.export.save wrote",
    )


def pickle_error(path: Path) -> SourceError:
    """Return the error for a pickle: what is in it, as its bytes say; it is never opened."""
    objects = sorted(name for name in _objects(path) if not _is_plain(name))
    if not objects:
        return SourceError(f"{path} holds weights alone (a state_dict, say), and no network to run.", MODULE_AGAIN)
    return SourceError(
        f"{path} is a pickle of Python objects ({_listed(objects)}), which may run any code when it is opened; it was "
        "not.",
        MODULE_AGAIN,
    )


def _is_plain(name: str) -> bool:
    module, _, word = name.rpartition(".")
    return name.partition(".")[0] in OWN_MODULES or (module in ("builtins", "__builtin__") and word in PLAIN_TYPES)


def _names(path: Path) -> list[str] | None:
    """Return the names in an archive; None for a file that begins like a pickle."""
    with path.open("rb") as stream:
        first = stream.read(4)
    if not first:
        raise SourceError(f"{path} is empty.", "copy or save it again")
    if first[:1] == b"\x80":
        return None
    if not first.startswith(b"PK"):
        raise SourceError(
            f"{path} is not a file that torch wrote: it begins with {first!r}.",
            "name what torch.jit.save or torch.export.save wrote",
        )
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise SourceError(f"{path} is damaged: {one_line(str(error), 100)}.", "copy or save it again") from error
    _check_growth(path, entries)
    return [entry.filename for entry in entries]


def _check_growth(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    packed, unpacked = path.stat().st_size, sum(entry.file_size for entry in entries)
    if unpacked > MAX_GROWTH * packed + (1 << 20) or len(entries) > limit("files"):
        raise SourceError(
            f"{path} has {packed:,} bytes and would unpack to {len(entries):,} files of {unpacked:,} bytes; torch "
            "stores weights without compression.",
            "take the file from where the policy was saved",
        )


def _objects(path: Path) -> set[str]:
    """Return the names of classes and functions that a pickle refers to, read from its operations."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                name = next(each for each in archive.namelist() if each.partition("/")[2] == "data.pkl")
                with archive.open(name) as stream:
                    content = stream.read(MAX_PICKLE_BYTES)
        else:
            with path.open("rb") as stream:
                content = stream.read(MAX_PICKLE_BYTES)
        return _referred(content)
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise SourceError(f"{path} is damaged: {one_line(str(error), 100)}.", "copy or save it again") from error


def _referred(content: bytes) -> set[str]:
    found: set[str] = set()
    texts: list[str] = []
    stream = io.BytesIO(content)
    while stream.tell() < len(content):  # an old file is several pickles in a row
        for operation, argument, _ in pickletools.genops(stream):
            if operation.name in TEXT_OPERATIONS:
                texts.append(str(argument))
            elif operation.name in ("GLOBAL", "INST"):
                found.add(str(argument).replace(" ", "."))
            elif operation.name == "STACK_GLOBAL":
                found.add(".".join(texts[-2:]))
        if content[stream.tell() : stream.tell() + 1] != b"\x80":
            break
    return found


def _listed(names: list[str]) -> str:
    shown = ", ".join(one_line(name, 60) for name in names[:4])
    return f"{shown}, ..." if len(names) > 4 else shown or "nothing"
