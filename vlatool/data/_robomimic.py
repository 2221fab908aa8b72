"""What robomimic writes beside the arrays of an episode: filter keys, numbers of samples, the rate, instructions.

Source: robomimic, ``utils/file_utils.py`` and ``scripts/dataset_states_to_obs.py``; instructions as RoboCasa writes
them for each episode (``ep_meta``), and LIBERO for a file (``problem_info``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.errors import DataError, suggest
from vlatool.files.printable import amount

MASK = "mask"
"""Group of the filter keys; ``--map mask=KEY`` chooses the episodes of one."""
INSTRUCTION = "instruction"
"""Column of the instructions that are written as attributes."""
MAX_ATTRIBUTE, MAX_HZ = 1 << 20, 1e6
"""Characters of JSON of an attribute that are read, and the rate above which it is none."""


def filter_keys(opened: Any) -> dict[str, list[str]]:
    """Return filter key -> names of the episodes that it stands for, in a file of h5py."""
    group = opened.get(MASK)
    if not hasattr(group, "keys"):
        return {}
    return {key: [_text(name) for name in np.asarray(group[key]).ravel().tolist()] for key in sorted(group)}


def chosen_by(keys: Mapping[str, list[str]], key: str, episodes: list[str], where: str) -> list[str]:
    """Return the episodes of a filter key, in the order of the file; all for an empty key.

    Raises:
        DataError: when there is no such key, or it names episodes that are not there.
    """
    if not key:
        return episodes
    if key not in keys:
        raise DataError(f"{where} has no filter key '{key}'; {suggest(key, keys)}.", "name one with --map mask=KEY")
    if missing := sorted({*keys[key]} - {*episodes}):
        raise DataError(f"The filter key '{key}' in {where} names {missing[0]}, which is not there.",
                        "write the filter key again: robomimic's split_train_val.py")  # fmt: skip
    return [name for name in episodes if name in {*keys[key]}]


def check_samples(group: Any, length: int, where: str) -> None:
    """Refuse an episode of another number of steps than robomimic reads of it.

    Raises:
        DataError: when ``num_samples`` is another number than that of the actions.
    """
    said = group.attrs.get("num_samples")
    if said is not None and (np.ndim(said) or int(said) != length):
        raise DataError(f"{where} has {length} actions, and num_samples is {said}.",
                        "record the episode again, or correct the attribute num_samples")  # fmt: skip


def rate_of(opened: Any) -> float:
    """Return the rate in Hz at which the environment of ``env_args`` is controlled; 0 where it does not say."""
    keywords = _json(opened["data"].attrs.get("env_args")).get("env_kwargs")
    rate = keywords.get("control_freq") if isinstance(keywords, dict) else None
    if isinstance(rate, bool) or not isinstance(rate, int | float):
        return 0.0
    return float(rate) if 0 < rate < MAX_HZ else 0.0


def instruction_of(opened: Any, group: Any) -> str:
    """Return the instruction of an episode, of its own or of the whole file; empty without."""
    own = _json(group.attrs.get("ep_meta")).get("lang")
    whole = _json(opened["data"].attrs.get("problem_info")).get("language_instruction")
    found = own if isinstance(own, str) and own.strip() else whole
    if isinstance(found, list):
        found = " ".join(map(str, found))
    return found.strip() if isinstance(found, str) else ""


def notes_on(opened: Any, key: str, count: int) -> tuple[str, ...]:
    """Return sentences on filter keys that are not used, and on a number of samples that is not that of the file."""
    keys, notes = filter_keys(opened), []
    if keys and not key:
        of = ", ".join(f"{name} ({amount(len(episodes), 'episode')})" for name, episodes in keys.items())
        notes.append(f"It has the filter keys {of}; all episodes are read: choose those of one with --map mask=KEY.")
    total = opened["data"].attrs.get("total")
    if total is not None and not key and not np.ndim(total) and int(total) != count:
        notes.append(f"Its attribute total is {int(total)}, and it has {amount(count, 'step')}.")
    return tuple(notes)


def _json(value: Any) -> dict[str, Any]:
    """Return an attribute of JSON; empty where it is none, or longer than is read."""
    written = _text(value) if isinstance(value, str | bytes) else ""
    try:
        found = json.loads(written) if 0 < len(written) <= MAX_ATTRIBUTE else {}
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
