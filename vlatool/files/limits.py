"""Limits on the size of untrusted input, by name, and how a user raises one.

``VLATOOL_LIMITS=golden_bytes=1e9,files=50000`` in the environment changes limits for one process.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from vlatool.errors import UsageError, VlatoolError, fix_for, suggest

LIMITS_VARIABLE = "VLATOOL_LIMITS"
KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30


@dataclass(frozen=True)
class Limit:
    """One limit.

    Args:
        default: largest allowed value.
        unit: unit of the value: ``bytes``, ``files``, ``levels``, ...
        what: subject of the limit, as a part of a sentence.
    """

    default: int
    unit: str
    what: str


LIMITS = {
    "manifest_bytes": Limit(4 * MIB, "bytes", "manifest.json"),
    "files": Limit(10_000, "files", "files of a bundle"),
    "bundle_bytes": Limit(64 * GIB, "bytes", "all recorded files of a bundle together"),
    "graphs": Limit(256, "graphs", "graphs of a bundle"),
    "json_depth": Limit(64, "levels", "nested lists and mappings in a JSON file"),
    "graph_depth": Limit(100, "levels", "nested messages in a graph (a subgraph takes three)"),
    "graph_fields": Limit(4_000_000, "fields", "parts of a graph that are gone through in search of weights beside it"),
    "golden_bytes": Limit(256 * MIB, "bytes", "the golden file, unpacked"),
    "golden_steps": Limit(64, "steps", "golden observations in a row"),
    "recording_bytes": Limit(8 * GIB, "bytes", "a recording of observations, unpacked"),
    "run_frame_bytes": Limit(256 * MIB, "bytes", "one control step of a recorded run"),
    "recorded_steps": Limit(100_000_000, "steps", "a dataset of recorded episodes"),
    "picture_bytes": Limit(256 * MIB, "bytes", "one recorded picture, decoded"),
    "arrays": Limit(4096, "arrays", "arrays in one .npz file"),
    "statistics_bytes": Limit(16 * MIB, "bytes", "a file of normalisation statistics"),
    "tokenizer_bytes": Limit(64 * MIB, "bytes", "a tokenizer or vocabulary"),
    "tokenizer_growth": Limit(10_000, "characters", "what a tokenizer may make of one character of a text"),
    "text_characters": Limit(1 << 22, "characters", "a text, as its tokenizer may lengthen it"),
    "elements": Limit(1 << 26, "elements", "one value of a program, or one input or output of a spec"),
    "state_elements": Limit(1 << 27, "elements", "all noise and kept values of a program together"),
    "tokens": Limit(1 << 20, "tokens", "the ids of one text"),
    "yaml_bytes": Limit(256 * KIB, "bytes", "a YAML file: a recipe, gate, profile or policy.yaml"),
    "yaml_depth": Limit(64, "levels", "nested lists and mappings in a YAML file"),
    "yaml_nodes": Limit(50_000, "nodes", "values of a YAML file, each alias counted as what it stands for"),
    "message_bytes": Limit(64 * MIB, "bytes", "one message of a client of vlatool serve, or one of its answers"),
    "target_message_bytes": Limit(32 * MIB, "bytes", "one message of the target of a benchmark"),
    "target_bytes": Limit(256 * MIB, "bytes", "all that the target of a benchmark sends"),
    "target_seconds": Limit(6 * 3600, "seconds", "a benchmark on a target, beside the time that was asked for"),
    "engine_seconds": Limit(3600, "seconds", "an engine that opens or runs a graph once where nobody has run it yet"),
    "environment_seconds": Limit(300, "seconds", "one call of an environment: make(), reset(), step() or close()"),
    "study_seconds": Limit(60, "seconds", "waiting for another process to write a trial into the file of a study"),
    "shipped_files": Limit(20_000, "files", "files of a folder that are sent to workers on other machines"),
    "shipped_bytes": Limit(16 * GIB, "bytes", "a folder that is sent to workers on other machines"),
    "repeat": Limit(10_000, "runs", "runs of one step of a program"),
    "runs": Limit(100_000, "runs", "runs of graphs in one inference"),
    "tensors": Limit(1024, "tensors", "inputs and outputs of a spec"),
    "steps": Limit(1024, "steps", "steps of a program"),
}
"""Name -> limit."""


def limit(name: str) -> int:
    """Return a limit: the default, or what ``VLATOOL_LIMITS`` says.

    Raises:
        UsageError: when the variable is malformed or names an unknown limit.

    Example:
        >>> limit("files")
        10000
    """
    text = os.environ.get(LIMITS_VARIABLE)
    return _parse_overrides(text).get(name, LIMITS[name].default) if text else LIMITS[name].default


def check_limit(name: str, got: int, where: str, error: type[VlatoolError]) -> None:
    """Refuse a value above a limit.

    Args:
        got: value, in the unit of the limit.
        where: what has that value, as the start of a sentence.
    """
    allowed = limit(name)
    if got > allowed:
        raise error(
            f"{where} has {_number(got)} {LIMITS[name].unit}; the limit '{name}' allows {allowed}.",
            f"if it is right, raise the limit: {LIMITS_VARIABLE}={name}={_number(got)}",
        )


def _number(value: int) -> str:
    """Return a number as text; thousands of digits are neither readable nor, for Python, printable."""
    return str(value) if value.bit_length() <= 64 else f"more than 2^{value.bit_length() - 1}"


def _parse_overrides(text: str) -> dict[str, int]:
    limits = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        if name not in LIMITS:
            raise UsageError(
                f"{LIMITS_VARIABLE} names the unknown limit '{name}'; {suggest(name, LIMITS)}.", fix_for(name, LIMITS)
            )
        limits[name] = _parse_limit(name, value)
    return limits


def _parse_limit(name: str, value: str) -> int:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not 0 <= number < 2**63:
        raise UsageError(
            f"{LIMITS_VARIABLE} sets {name} to '{value[:40]}'; it must be a number of {LIMITS[name].unit} from 0.",
            f"write it as {LIMITS_VARIABLE}={name}={LIMITS[name].default}, or leave it out",
        )
    return int(value) if value.isdigit() else int(number)
