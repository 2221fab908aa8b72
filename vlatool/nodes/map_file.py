"""Maps as they are typed: ``name=/topic``, or for any policy a file that says which topic is which input."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vlatool import registry
from vlatool.errors import DataError, UsageError, require
from vlatool.files.json import read_json
from vlatool.files.yaml import read_mapping
from vlatool.nodes.settings import MAX_BYTES

FIX = "print a proposed one: vlatool run policy --bundle BUNDLE --print-map"


def split_maps(words: Sequence[str], *, takes_file: bool) -> tuple[dict[str, str], dict[str, Any]]:
    """Return topics by name, and settings from the file among the words.

    Args:
        words: What ``--map`` was given, each time.
        takes_file: Whether the controller takes a file.

    Raises:
        UsageError: for a word that is neither, a name that is mapped twice, or two files.
        DataError: when the file cannot be read.
    """
    topics: dict[str, str] = {}
    settings: dict[str, Any] = {}
    for word in words:
        name, sign, topic = word.partition("=")
        if sign and not Path(word).is_file():
            if not name or not topic or name in topics:
                reason = "is mapped twice" if name in topics else "is not of the form NAME=/TOPIC"
                raise UsageError(f"--map {word} {reason}.", "write each once, such as --map scan=/front/scan")
            topics[name] = topic
        elif not takes_file:
            raise UsageError(f"--map {word} is not of the form NAME=/TOPIC.", "write it such as --map scan=/front/scan")
        elif settings:
            raise UsageError(f"Two maps are named; the second is {word}.", "name one file")
        else:
            settings = {"map": read_map(Path(word))}
    return topics, settings


def read_map(path: Path) -> dict[str, Any]:
    """Return the content of a map in YAML or JSON.

    Raises:
        DataError: when it cannot be read, has a key twice or is not a mapping.
        MissingExtra: for YAML where its library is absent, as on a robot; JSON is read everywhere.
    """
    what = f"The map {path}"
    if path.suffix != ".json":
        return read_mapping(path, what, DataError)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise DataError(f"{what} cannot be read: {error.strerror}.", "check the path") from None
    if len(content) > MAX_BYTES:
        raise DataError(f"{what} has more than {MAX_BYTES:,} bytes.", FIX)
    values = read_json(content, what, DataError, FIX, strict=True)
    if not isinstance(values, dict):
        raise DataError(f"{what} is not a mapping of inputs and outputs.", FIX)
    return values


def proposed_text(bundle: Path) -> str:
    """Return a proposed map for a bundle, as YAML."""
    from vlatool.bundle.bundle import Bundle

    yaml: Any = require("yaml", "build")
    controller: Any = registry.load("controllers", "policy")
    text: str = yaml.safe_dump(
        controller.propose(Bundle.open(bundle).manifest.spec), sort_keys=False, default_flow_style=None
    )
    return f"# Proposed by the spec of the bundle: check topics, joints and units against the robot.\n{text}"
